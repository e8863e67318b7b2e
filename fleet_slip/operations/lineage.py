"""OpenLineage events of the runs of a data root: which tables a command read and wrote.

A run emits START, then COMPLETE, FAIL or ABORT, to a file (one JSON document a line) or a server.
The format is that of https://openlineage.io/docs/spec/object-model, written by openlineage-python.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.metadata import version as package_version
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from fleet_slip.base import require_extra
from fleet_slip.errors import INTERRUPTED, FleetSlipError, UsageError, hide_passwords
from fleet_slip.models.registry import Registry
from fleet_slip.storage.runs import LOGGER, Run

if TYPE_CHECKING:
    from fleet_slip.warehouse.warehouse import Warehouse

TIMEOUT_S = 5.0
"""Timeout of the server, in s. A server that is down delays a run by twice this time."""

MODELS = "models"

INPUT_TABLES: Mapping[str, tuple[str, ...]] = {
    "gram": ("logs",),
    "publish": ("grams",),
    "run": ("logs", "grams"),
    "learn": ("logs", "grams"),
    "nightly": ("logs", "grams", MODELS),
    "evaluate": ("logs", "grams", MODELS),
    "watch": ("logs", MODELS),
    "compact": ("logs", "grams", "quarantine"),
    "forget": ("logs", "grams", "quarantine", MODELS),
    "migrate": ("logs", "grams"),
    **dict.fromkeys(("promote", "rollback", "pin", "unpin"), (MODELS,)),
}
"""Tables that a command reads, where they exist."""

INPUT_ARGUMENTS = ("files", "logs", "inbox")
"""Arguments that name measured logs. Events contain their folders, as file names may identify a
driver."""


@contextmanager
def emit_lineage(
    target: str, warehouse: "Warehouse", run: Run, arguments: Mapping[str, Any]
) -> Iterator[None]:
    """Emit the events of a run to a file or a URL. Errors of emitting are warnings.

    Raises
    ------
    UsageError
        If the target is not a URL of http or https, and no file that can be created.
    ExtraError
        If openlineage-python is not installed.
    """
    with require_extra("lineage", "--lineage"):
        from openlineage.client import event_v2, facet_v2  # noqa: PLC0415 - an extra
        from openlineage.client.uuid import generate_new_uuid  # noqa: PLC0415

        emit = _emitter(target)
    before = _table_versions(warehouse)
    folders = _log_folders(arguments)
    run_id = str(generate_new_uuid())
    job_type = facet_v2.job_type_job.JobTypeJobFacet("BATCH", "FLEET_SLIP", "COMMAND")
    producer = f"pkg:pypi/fleet-slip@{package_version('fleet-slip')}"
    namespace = hide_passwords(str(warehouse.root), to_end=True)

    def dataset(kind: Any, name: str, version: int | None = None) -> Any:
        where = urlsplit(name)
        place = f"{where.scheme}://{where.netloc}" if where.netloc else "file"
        path = where.path.lstrip("/") if where.netloc else str(Path(name).absolute())
        version_facet = facet_v2.dataset_version_dataset.DatasetVersionDatasetFacet
        facets = {} if version is None else {"version": version_facet(str(version))}
        return kind(namespace=place, name=path, facets=facets)

    def send(state: event_v2.RunState, outputs: Mapping[str, int], error: str | None) -> None:
        message = facet_v2.error_message_run.ErrorMessageRunFacet(error or "", "PYTHON")
        facets: dict[str, Any] = {"errorMessage": message} if error else {}
        inputs = [dataset(event_v2.InputDataset, folder) for folder in folders]
        inputs += [
            dataset(event_v2.InputDataset, f"{warehouse.root}/{table}", before[table])
            for table in INPUT_TABLES.get(run.command, ())
            if table in before
        ]
        event = event_v2.RunEvent(
            eventTime=datetime.now(UTC).isoformat(),
            eventType=state,
            run=event_v2.Run(run_id, facets),
            job=event_v2.Job(namespace, run.command, {"jobType": job_type}),
            inputs=inputs,
            outputs=[
                dataset(event_v2.OutputDataset, f"{warehouse.root}/{table}", version)
                for table, version in outputs.items()
            ],
            producer=producer,
        )
        try:
            emit(event)
        except Exception as failure:  # of any transport: the run continues
            LOGGER.warning(
                "lineage: the event %s cannot be sent to %s: %s. The run continues.",
                *(state.value, hide_passwords(target, to_end=True), failure),
            )

    start = time.monotonic()
    send(event_v2.RunState.START, {}, None)
    error: BaseException | None = None
    try:
        yield
    except BaseException as caught:
        error = caught
        raise
    finally:
        end = run.end(error, time.monotonic() - start)
        states = {0: event_v2.RunState.COMPLETE, INTERRUPTED: event_v2.RunState.ABORT}
        after = _table_versions(warehouse)
        written = {table: number for table, number in after.items() if before.get(table) != number}
        send(states.get(end["exit_code"], event_v2.RunState.FAIL), written, end["error"])


def _emitter(target: str) -> Callable[[Any], object]:
    """Return the function that sends an event to a file or a URL. Raises `UsageError`."""
    from openlineage.client.transport import get_default_factory  # noqa: PLC0415 - an extra

    valid, config = False, dict[str, Any]()
    if "://" not in target:
        valid = Path(target).parent.is_dir() and not Path(target).is_dir()
        config = {"type": "file", "log_file_path": target, "append": True}
    else:
        with suppress(ValueError):  # a port that is no number of a port
            url = urlsplit(target)
            valid = url.scheme in ("http", "https") and bool(url.hostname) and url.port != 0
            config = {"type": "http", "url": f"{url.scheme}://{url.netloc}", "timeout": TIMEOUT_S}
            config |= {"endpoint": endpoint} if (endpoint := url.path.strip("/")) else {}
            config["retry"] = {"total": 0}
    if not valid:
        raise UsageError(
            f"--lineage {hide_passwords(target, to_end=True)}: name a file in a folder that "
            "exists, or a URL of a server such as http://HOST:PORT."
        )
    emit: Callable[[Any], object] = get_default_factory().create(config).emit
    return emit


def _table_versions(warehouse: "Warehouse") -> dict[str, int]:
    """Return the versions of the readable tables; for models, the number of versions.

    A damaged table has none: the command itself reports the damage, and its event is sent.
    """
    versions: dict[str, int] = {}
    if not warehouse.root.exists():
        return versions
    for table in warehouse.tables:
        with suppress(FleetSlipError):
            if (version := table.snapshot().version) is not None:
                versions[table.folder.name] = version
    with suppress(FleetSlipError):
        registry = Registry.open(warehouse)
        if number := sum(len(registry.versions(name)) for name in registry.names()):
            versions[MODELS] = number
    return versions


def _log_folders(arguments: Mapping[str, Any]) -> list[str]:
    """Return the folders of the measured logs among the arguments of a command."""
    values = [arguments.get(argument) or () for argument in INPUT_ARGUMENTS]
    lists = [[value] if isinstance(value, str | Path) else value for value in values]
    names = [Path(name) for names in lists for name in names]
    return sorted({str(name if name.is_dir() else name.parent) for name in names})
