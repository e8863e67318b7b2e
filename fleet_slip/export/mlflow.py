"""Logs a version to an MLflow server and registers it, as a pyfunc model that computes `predict`.

MLflow and pandas are the extra `fleet-slip[mlflow]`; they are imported when they are used.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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

from fleet_slip.base import pluralize
from fleet_slip.errors import ConfigError, StorageError, UsageError
from fleet_slip.export.compile import Check
from fleet_slip.export.files import Subject, document_of, render
from fleet_slip.export.program import Program
from fleet_slip.models.registry import ModelVersion

LOADER = "fleet_slip.export.mlflow_model"
DOCUMENT = "estimator.json"
EXAMPLE_ROWS = 50
ANSWER_S = 10.0
"""So long a server may take to say that it is there."""
LONGEST_PARAMETER = 500
"""Characters; newer versions of MLflow take 6,000."""
SHA256_TAG = "fleet_slip.sha256"

_TEXTS = ("vehicle_id", "vehicle_model", "campaign", "track", "source")


def log_to_mlflow(uri: str, subject: Subject, aliases: Mapping[str, int]) -> str:
    """Register a version under its model's name; return the number that MLflow gave it.

    One that is registered already, by its checksum, is not registered again; `aliases` that point
    at it here point at it there. Raises `UsageError`
    for a URI with a password, and `StorageError` if the server does not take it.
    """
    if urlsplit(uri).username is not None or urlsplit(uri).password is not None:
        raise UsageError(
            "the URI of MLflow has a name or password in it, which logs would keep. Set "
            "MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD instead."
        )
    mlflow, version = _library(), subject.version
    require_answer(uri, version.reference)
    try:
        with _tracking(mlflow, uri), TemporaryDirectory() as folder:
            number = _registered(mlflow, version) or _log(mlflow, subject, Path(folder))
            describe(mlflow.MlflowClient(), version, number, aliases)
            return number
    except mlflow.exceptions.MlflowException as error:
        told = shorten(str(error), 300, placeholder=" …")
        raise _not_taken(version.reference, told) from None


def require_answer(uri: str, reference: str, patience_s: float = ANSWER_S) -> None:
    """Raise `StorageError` if no server answers at a URI of HTTP, whatever its answer.

    MLflow itself asks again for minutes. What is wrong with a certificate is left to it, since it
    may know another authority.
    """
    if urlsplit(uri).scheme not in {"http", "https"}:
        return
    try:
        with urlopen(f"{uri.rstrip('/')}/health", timeout=patience_s):  # noqa: S310 - see above
            return
    except HTTPError:
        return
    except (OSError, HTTPException) as error:  # URLError among them
        reason = getattr(error, "reason", error)
        if isinstance(reason, SSLError):
            return
        told = "no answer" if isinstance(reason, TimeoutError) else str(reason)
        raise _not_taken(
            reference, f"nothing answers at {uri} within {patience_s:g} s ({told})."
        ) from None


def _not_taken(reference: str, why: str) -> StorageError:
    return StorageError(
        f"{reference} is published here, but MLflow rejected it: {why} Publish it again when "
        "the server answers."
    )


def _library() -> Any:
    """Return MLflow. Raises `ConfigError` without it."""
    try:
        import mlflow  # noqa: PLC0415 - the library is optional
        import pandas as pd  # noqa: F401, PLC0415
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"MLflow needs the package {error.name}. Run: pip install 'fleet-slip[mlflow]'"
        ) from None
    return mlflow


@contextmanager
def _tracking(mlflow: Any, uri: str) -> Iterator[None]:
    before = mlflow.get_tracking_uri(), mlflow.get_registry_uri()
    mlflow.set_tracking_uri(uri)
    mlflow.set_registry_uri(uri)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(before[0])
        mlflow.set_registry_uri(before[1])


def _registered(mlflow: Any, version: ModelVersion) -> str | None:
    """Return the number of a version that is registered already."""
    client = mlflow.MlflowClient()
    name = version.manifest.name
    for one in client.search_model_versions(f"name = '{name}'"):
        if one.tags.get(SHA256_TAG) == version.sha256:
            return str(one.version)
    return None


def _log(mlflow: Any, subject: Subject, folder: Path) -> str:
    version, program = subject.version, subject.program
    manifest = version.manifest
    (folder / DOCUMENT).write_text(render(document_of(subject)), "utf-8")
    tags = _tags(version)
    with mlflow.start_run(run_name=version.reference, tags=tags):
        mlflow.log_params(parameters(version))
        mlflow.log_metrics(_metrics(version))
        logged = mlflow.pyfunc.log_model(
            name=manifest.name,
            loader_module=LOADER,
            data_path=str(folder / DOCUMENT),
            signature=_signature(mlflow, program),
            input_example=_example(program, subject.checks[0]),
            registered_model_name=manifest.name,
            pip_requirements=[f"fleet-slip=={package_version('fleet-slip')}"],
            metadata=tags,
        )
    client = mlflow.MlflowClient()
    number = str(logged.registered_model_version)
    for key, value in tags.items():
        client.set_model_version_tag(manifest.name, number, key, value)
    return number


def describe(client: Any, version: ModelVersion, number: str, aliases: Mapping[str, int]) -> None:
    """Give a registered version a description, and the aliases that it has here."""
    name, trained = version.manifest.name, version.manifest.trained_on
    told = (
        f"{version.reference} of fleet_slip, trained on {pluralize(trained.drives, 'drive')} where "
        f"{trained.cohort}. {version.manifest.selected_by.reason}"
    )
    client.update_model_version(name, number, description=told)
    for alias in sorted(one for one, which in aliases.items() if which == version.version):
        client.set_registered_model_alias(name, alias, number)


def parameters(version: ModelVersion) -> dict[str, str]:
    """Return what the version was made with, by name, as short as every MLflow takes it."""
    trained, chosen = version.manifest.trained_on, version.manifest.selected_by
    told = {
        "cohort": trained.cohort,
        "feature_set": trained.feature_set,
        "drives": trained.drives,
        "rows": trained.rows,
        "model_list": chosen.model_list,
        "model": chosen.model,
        "signals": ",".join(version.manifest.signals),
        **(chosen.asked or {}),
    }
    return {key: str(value)[:LONGEST_PARAMETER] for key, value in told.items()}


def _tags(version: ModelVersion) -> dict[str, str]:
    trained = version.manifest.trained_on
    return {
        "fleet_slip.reference": version.reference,
        SHA256_TAG: version.sha256,
        "fleet_slip.drives_sha256": trained.drives_sha256,
        "fleet_slip.drives": str(trained.drives),
        "fleet_slip.feature_set": trained.feature_set,
        "fleet_slip.model": version.manifest.selected_by.model,
    }


def _metrics(version: ModelVersion) -> dict[str, float]:
    content = version.manifest.cross_validation.model_dump(mode="json")
    return {k: float(v) for k, v in content.items() if isinstance(v, int | float)}


def _columns(program: Program) -> dict[str, str]:
    """Return what a row must have, and of which type."""
    facts = {one.name: "string" if one.name in _TEXTS else "double" for one in program.facts}
    numbers = {one.name: "double" for one in program.numbers}
    return {one.column: "double" for one in program.signals} | facts | numbers


def _signature(mlflow: Any, program: Program) -> Any:
    types = mlflow.types
    given = [types.ColSpec(kind, name) for name, kind in _columns(program).items()]
    if program.rings:
        given += [
            types.ColSpec("string", "drive_id", required=False),
            types.ColSpec("long", "tick", required=False),
        ]
    angle = types.Schema([types.ColSpec("double", program.angle.column)])
    return mlflow.models.ModelSignature(inputs=types.Schema(given), outputs=angle)


def _example(program: Program, check: Check) -> Any:
    """Return the first ticks of a check in SI units, as a frame; nothing is known of the car."""
    import pandas as pd  # noqa: PLC0415 - the library is optional

    samples = check.samples[:EXAMPLE_ROWS]
    columns: dict[str, Any] = {}
    for one, counts in zip(program.signals, zip(*samples, strict=True), strict=True):
        columns[one.column] = [None if n is None else n * float(one.scale) for n in counts]
    kinds = _columns(program)
    frame = pd.DataFrame({name: columns.get(name, [None] * len(samples)) for name in kinds})
    return frame.astype({n: "float64" for n, kind in kinds.items() if kind == "double"})
