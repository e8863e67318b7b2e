"""The pyfunc model that MLflow loads; its `predict` is that of the version."""

import json
from pathlib import Path
from typing import Any

from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.config import parse_document
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import predict
from fleet_slip.warehouse.warehouse import open_warehouse


class LoggedVersion:
    """A version as a pyfunc model.

    Parameters
    ----------
    signals
        Signals of the configs that the environment names, or the shipped ones.
    manifest
        Manifest of the version.
    """

    def __init__(self, signals: SignalCatalog, manifest: Manifest) -> None:
        self.signals = signals
        self.manifest = manifest

    def predict(self, model_input: Any, params: Any = None) -> Any:  # noqa: ARG002 - MLflow passes it
        """Return a frame with the angle of each row in rad. Raises as `predict`."""
        angles = predict(self.signals, self.manifest, model_input)
        return angles.to_frame()


def _load_pyfunc(path: str) -> LoggedVersion:
    """Load the model of an exported document, for MLflow."""
    content = json.loads(Path(path).read_text("utf-8"))
    signals = open_warehouse().catalog.signals
    manifest = content["model"]["manifest"]
    return LoggedVersion(signals, parse_document(manifest, Manifest, path, "its manifest", signals))
