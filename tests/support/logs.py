"""Rows of logs made up in memory, and landed in a warehouse."""

import hashlib
from collections.abc import Collection
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.models.registry import Registry
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import AppTransaction, Change
from fleet_slip.views import open_views
from fleet_slip.warehouse.warehouse import Warehouse, open_warehouse
from tests.support.catalog import CATALOG, SIGNALS

DAY = date(2024, 5, 1)


def path_of(folder: Folder) -> Path:
    """Return where a folder of a file system is."""
    return Path(str(folder))


def ask(
    root: Folder | Path | Warehouse, query: str, parameters: Any = None
) -> list[tuple[Any, ...]]:
    """Return the answer to a query, for which no view is opened that it does not name."""
    warehouse = root if isinstance(root, Warehouse) else open_warehouse(root)
    with open_views(warehouse, query) as database:
        return database.execute(query, parameters).fetchall()


def without_names(drives: pa.Table) -> pa.Table:
    """Return rows of the logs without what depends on their file: its digest and its name."""
    return drives.drop_columns(["drive_id", "trip_id", "drive_name", "source_file"])


def random_counts(rng: np.random.Generator, rows: int) -> dict[str, Any]:
    """Counts over the whole int16 range, the extremes among them."""
    counts: dict[str, Any] = {}
    for name in SIGNALS.signals:
        values = rng.integers(-32768, 32768, rows)
        values[:2] = (-32768, 32767)
        counts[name] = values.astype(np.int16)
    return counts


def schema_without(optional: Collection[str]) -> pa.Schema:
    """The schema of a file of the logs whose drives have nothing of some optional columns."""
    return pa.schema([field for field in SIGNALS.log_schema if field.name not in optional])


def log_rows(
    drive_id: str,
    counts: dict[str, Any],
    day: date = DAY,
    signals: SignalCatalog = SIGNALS,
    **metadata: Any,
) -> pa.Table:
    """Rows of the logs for one drive; a signal that is not given is absent."""
    rows = len(next(iter(counts.values())))
    facts: dict[str, Any] = {
        "drive_id": drive_id,
        "vehicle_id": "car-1",
        "vehicle_model": "d_class_sedan",
        "source": "simulated",
        "campaign": "test",
        "track": "waterford_hills",
        "mass_kg": 1320.0,
        "adhesion": 1.0,
        "speed_factor": 0.8,
        "duration_s": (rows - 1) / 100,
        "rows": rows,
        "saturated": 0,
        "day": day,
        **metadata,
    }
    columns = {"tick": np.arange(rows, dtype=np.int32), **counts}
    schema = signals.log_schema
    arrays = [
        pa.array(columns[field.name], field.type)
        if field.name in columns
        else pa.repeat(pa.scalar(facts.get(field.name), field.type), rows)
        for field in schema
    ]
    return pa.table(arrays, schema=schema)


def land(warehouse: Warehouse, name: str, *drives: pa.Table, day: date = DAY) -> None:
    """Commit drives as one file of the logs."""
    action = warehouse.logs.write_file(name, pa.concat_tables(drives), day)
    warehouse.logs.snapshot().commit(
        Change(add=[action], transactions=[AppTransaction(f"test/{name}", 1)])
    )


def state(root: Path, model: str = "smoke") -> dict[str, Any]:
    """All that a data root holds, apart from the moments at which it was written."""
    warehouse = Warehouse(LocalFolder(root))
    files = {
        path: hashlib.sha256(Path(path).read_bytes()).hexdigest()
        for table in (warehouse.logs, warehouse.grams)
        for path in table.snapshot().paths
    }
    registry = Registry(LocalFolder(root), CATALOG)
    return {
        "files": {Path(path).relative_to(root): digest for path, digest in files.items()},
        "versions": [registry.load(model, n).sha256 for n in registry.versions(model)],
        "aliases": registry.history(model).aliases(),
        "moves": [(move.command, move.version) for move in registry.history(model).moves()],
    }
