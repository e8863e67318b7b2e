"""Logs a version to an MLflow server and registers it as a pyfunc model with `predict`.

MLflow and pandas are the extra `fleet-slip[mlflow]`, imported on use.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPException
from importlib.metadata import version as package_version
from pathlib import Path
from ssl import SSLError
from tempfile import TemporaryDirectory
from textwrap import shorten
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

from fleet_slip.base import install_command, pluralize
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.config import parse_document
from fleet_slip.errors import ConfigError, StorageError, UsageError
from fleet_slip.export.files import Subject, document_of, render
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import TestVector
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import predict
from fleet_slip.models.registry import ModelVersion
from fleet_slip.warehouse.warehouse import open_warehouse

DOCUMENT = "estimator.json"
EXAMPLE_ROWS = 50
ANSWER_S = 10.0
"""Timeout of the request that checks that the server answers, in s."""
MAX_PARAMETER_CHARACTERS = 500
"""Maximum length of a parameter. Newer versions of MLflow accept 6,000 characters."""
SHA256_TAG = "fleet_slip.sha256"

_TEXTS = ("vehicle_id", "vehicle_model", "campaign", "track", "source")


def log_to_mlflow(uri: str, subject: Subject, aliases: Mapping[str, int]) -> str:
    """Register a version under the name of its model; return its number in MLflow.

    A version with the same checksum is not registered again. The `aliases` of the version are
    copied. Raises `UsageError` for a URI with a password, and `StorageError` if the server rejects
    it; `ConfigError` without the package.
    """
    if urlsplit(uri).username is not None or urlsplit(uri).password is not None:
        raise UsageError(
            "the URI of MLflow contains a name or password, which logs would store. Set "
            "MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD instead."
        )
    try:
        import mlflow  # noqa: PLC0415 - optional package
        import pandas as pd  # noqa: F401, PLC0415
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"MLflow needs the package {error.name}. {install_command('mlflow')}"
        ) from None
    version = subject.version
    require_answer(uri, version.reference)
    earlier = mlflow.get_tracking_uri(), mlflow.get_registry_uri()
    try:
        mlflow.set_tracking_uri(uri)
        mlflow.set_registry_uri(uri)
        client, name = mlflow.MlflowClient(), version.manifest.name
        registered = client.search_model_versions(f"name = '{name}'")
        same = [v for v in registered if v.tags.get(SHA256_TAG) == version.sha256]
        number = str(same[0].version) if same else _log(mlflow, subject)
        describe(client, version, number, aliases)
    except mlflow.exceptions.MlflowException as error:
        reason = shorten(str(error), 300, placeholder=" …")
        raise _rejected(version.reference, reason) from None
    finally:
        mlflow.set_tracking_uri(earlier[0])
        mlflow.set_registry_uri(earlier[1])
    return number


def require_answer(uri: str, reference: str, timeout_s: float = ANSWER_S) -> None:
    """Raise `StorageError` if no server answers at an HTTP URI; any answer is accepted.

    MLflow itself retries for minutes. It also checks certificates, as it may trust other
    authorities.
    """
    if urlsplit(uri).scheme not in {"http", "https"}:
        return
    try:
        with urlopen(f"{uri.rstrip('/')}/health", timeout=timeout_s):  # noqa: S310 - see above
            return
    except HTTPError:
        return
    except (OSError, HTTPException) as error:  # URLError among them
        if not isinstance(getattr(error, "reason", error), SSLError):
            reason = f"nothing answers at {uri} within {timeout_s:g} s ({error})."
            raise _rejected(reference, reason) from None


def _rejected(reference: str, reason: str) -> StorageError:
    return StorageError(
        f"{reference} is published here, but MLflow rejected it: {reason} Export it again when "
        "the server answers."
    )


def _log(mlflow: Any, subject: Subject) -> str:
    """Register a version; return its number."""
    version, program = subject.version, subject.program
    manifest, trained = version.manifest, version.manifest.trained_on
    tags = {
        "fleet_slip.reference": version.reference,
        SHA256_TAG: version.sha256,
        "fleet_slip.drives_sha256": trained.drives_sha256,
        "fleet_slip.drives": str(trained.drives),
        "fleet_slip.feature_set": trained.feature_set,
        "fleet_slip.model": manifest.selected_by.model,
    }
    metrics = manifest.cross_validation.model_dump(mode="json")
    with TemporaryDirectory() as folder, mlflow.start_run(run_name=version.reference, tags=tags):
        document = Path(folder) / DOCUMENT
        document.write_text(render(document_of(subject)), "utf-8")
        mlflow.log_params(parameters(version))
        mlflow.log_metrics({k: float(v) for k, v in metrics.items() if isinstance(v, int | float)})
        logged = mlflow.pyfunc.log_model(
            name=manifest.name,
            loader_module=__name__,
            data_path=str(document),
            signature=_signature(mlflow, program),
            input_example=_example(program, subject.checks[0]),
            registered_model_name=manifest.name,
            pip_requirements=[f"fleet-slip=={package_version('fleet-slip')}"],
            metadata=tags,
        )
    number = str(logged.registered_model_version)
    for key, value in tags.items():
        mlflow.MlflowClient().set_model_version_tag(manifest.name, number, key, value)
    return number


def describe(client: Any, version: ModelVersion, number: str, aliases: Mapping[str, int]) -> None:
    """Set the description of a registered version, and copy its aliases."""
    name, trained = version.manifest.name, version.manifest.trained_on
    description = (
        f"{version.reference} of fleet_slip, trained on {pluralize(trained.drives, 'drive')} where "
        f"{trained.cohort}. {version.manifest.selected_by.reason}"
    )
    client.update_model_version(name, number, description=description)
    for alias in sorted(a for a, target in aliases.items() if target == version.version):
        client.set_registered_model_alias(name, alias, number)


def parameters(version: ModelVersion) -> dict[str, str]:
    """Return the training parameters of a version, cut to the length that MLflow accepts."""
    trained, chosen = version.manifest.trained_on, version.manifest.selected_by
    values = {
        "cohort": trained.cohort,
        "feature_set": trained.feature_set,
        "drives": trained.drives,
        "rows": trained.rows,
        "model_list": chosen.model_list,
        "model": chosen.model,
        "signals": ",".join(version.manifest.signals),
        **(chosen.options or {}),
    }
    return {key: str(value)[:MAX_PARAMETER_CHARACTERS] for key, value in values.items()}


def _columns(program: Program) -> dict[str, str]:
    """Return the columns of a row, and their types."""
    names = [*(s.column for s in program.signals), *(f.name for f in program.facts)]
    names += [number.name for number in program.numbers]
    return {name: "string" if name in _TEXTS else "double" for name in names}


def _signature(mlflow: Any, program: Program) -> Any:
    types = mlflow.types
    inputs = [types.ColSpec(kind, name) for name, kind in _columns(program).items()]
    for name, kind in {"drive_id": "string", "tick": "long"}.items() if program.rings else ():
        inputs.append(types.ColSpec(kind, name, required=False))
    angle = types.Schema([types.ColSpec("double", program.angle.column)])
    return mlflow.models.ModelSignature(inputs=types.Schema(inputs), outputs=angle)


def _example(program: Program, check: TestVector) -> Any:
    """Return the first ticks of a check in SI units as a frame, for an unknown car."""
    import pandas as pd  # noqa: PLC0415 - optional package

    samples = check.samples[:EXAMPLE_ROWS]
    columns: dict[str, Any] = {}
    for signal, counts in zip(program.signals, zip(*samples, strict=True), strict=True):
        scale = float(signal.scale)
        columns[signal.column] = [None if n is None else n * scale for n in counts]
    kinds = _columns(program)
    frame = pd.DataFrame({name: columns.get(name, [None] * len(samples)) for name in kinds})
    return frame.astype({n: "float64" for n, kind in kinds.items() if kind == "double"})


@dataclass(frozen=True)
class LoggedVersion:
    """A version as a pyfunc model.

    Parameters
    ----------
    signals
        Signals of the configs that the environment names, or the shipped ones.
    manifest
        Manifest of the version.
    """

    signals: SignalCatalog
    manifest: Manifest

    def predict(self, model_input: Any, params: Any = None) -> Any:  # noqa: ARG002 - MLflow passes it
        """Return a frame with the angle of each row in rad. Raises as `predict`."""
        return predict(self.signals, self.manifest, model_input).to_frame()


def _load_pyfunc(path: str) -> LoggedVersion:
    """Load the model of an exported document, for MLflow."""
    content = json.loads(Path(path).read_text("utf-8"))
    signals = open_warehouse().catalog.signals
    manifest = content["model"]["manifest"]
    return LoggedVersion(signals, parse_document(manifest, Manifest, path, "its manifest", signals))
