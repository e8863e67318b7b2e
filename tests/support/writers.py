"""Writers, a job that rearranges, and readers at once, in processes of their own."""

import multiprocessing
import tempfile
import time
from dataclasses import dataclass
from datetime import date
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.job import update_grams
from fleet_slip.operations.find_drives import vacuum
from fleet_slip.operations.rewriting import compact
from fleet_slip.operations.verify import verify
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change, Table, Unit, retry_conflicts
from fleet_slip.warehouse.tables import Warehouse

DAY = date(2024, 5, 1)
ROWS = 20
FILES_OF_A_COMMIT = 2
READERS = 2
HOST_CLOCKS_APART_S = 86_400.0


@dataclass(frozen=True)
class Read:
    """What a reader saw."""

    snapshots: int
    torn: int
    steps_back: int


def rows_of(drive: str) -> pa.Table:
    """Return rows of one drive."""
    signals = catalogue()
    known = {"drive_id": drive, "vehicle_id": drive.partition("-")[0], "source": "simulated"}
    columns = {name: [known.get(name)] * ROWS for name in signals.drive}
    counts = {name: np.arange(ROWS) for name in signals.signals}
    table = {"day": [DAY] * ROWS, **columns, "tick": np.arange(ROWS), **counts}
    return pa.table(table, schema=signals.log_schema)


def write(root: Path, writer: int, commits: int) -> None:
    """Land commits of two files each; every second writer's clock is a day slow."""
    if writer % 2:
        real = time.time
        time.time = lambda: real() - HOST_CLOCKS_APART_S
    logs = Warehouse(LocalFolder(root)).logs
    for number in range(commits):
        name = f"car{writer}-{number}"
        actions = [
            logs.write_file(name, rows_of(f"{name}-{part}"), DAY)
            for part in range(FILES_OF_A_COMMIT)
        ]
        retry_conflicts(partial(_land, logs, Change(add=actions, units=[Unit(f"write/{name}", 1)])))


def _land(logs: Table, change: Change) -> None:
    snapshot = logs.snapshot()
    if snapshot.landed(change.units[0].name) is None:
        snapshot.commit(change)


def rearrange(root: Path, stop: Event) -> None:
    """Compact, aggregate and vacuum all the while."""
    warehouse = Warehouse(LocalFolder(root))
    while not stop.is_set():
        update_grams(warehouse)
        compact(warehouse, target_rows=400)
        vacuum(warehouse, 1)


def read(root: Path, stop: Event, answer: "multiprocessing.Queue[Read]") -> None:
    """Look at snapshots, and read every row of them, until told to stop."""
    snapshots = torn = steps_back = 0
    version = -1
    while not stop.is_set():
        snapshot = Warehouse(LocalFolder(root)).logs.snapshot()
        if snapshot.version is None:
            continue
        steps_back += snapshot.version < version
        version = snapshot.version
        parts = [pq.read_table(path, columns=["drive_id"]) for path in snapshot.paths]
        seen: dict[str, int] = {}
        for part in parts:
            for drive in part["drive_id"].to_pylist():
                seen[drive] = seen.get(drive, 0) + 1
        commits = {name.rpartition("-")[0] for name in seen}
        whole = len(seen) == FILES_OF_A_COMMIT * len(commits)
        torn += not (whole and set(seen.values()) <= {ROWS})
        snapshots += 1
    answer.put(Read(snapshots, torn, steps_back))


def concurrency(writers: int, commits: int, patience_s: float) -> str:
    """Let writers, a rearranging job and readers work at once; say that nothing went wrong.

    Raises `AssertionError` otherwise, and where the writers take longer than the patience.
    """
    context = multiprocessing.get_context("spawn")
    process_of = partial(context.Process, daemon=True)  # ends with the test at the latest
    stop, answer = context.Event(), context.Queue()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        started = time.monotonic()
        working = [
            process_of(target=write, args=(root, writer, commits)) for writer in range(writers)
        ]
        watching = [process_of(target=read, args=(root, stop, answer)) for _ in range(READERS)]
        watching.append(process_of(target=rearrange, args=(root, stop)))
        for process in (*working, *watching):
            process.start()
        for process in working:
            process.join(patience_s)
        seconds = time.monotonic() - started
        stop.set()
        reads = [answer.get(timeout=patience_s) for _ in range(READERS)]
        for process in (*working, *watching):
            process.join(patience_s)
            assert process.exitcode == 0
        warehouse = Warehouse(LocalFolder(root))
        compact(warehouse)
        update_grams(warehouse)
        logs = warehouse.logs.snapshot()
        assert logs.rows == writers * commits * FILES_OF_A_COMMIT * ROWS, logs.rows
        assert warehouse.grams.snapshot().rows == writers * commits * FILES_OF_A_COMMIT
        assert not verify(warehouse, full=True).damage
    snapshots = sum(one.snapshots for one in reads)
    assert not sum(one.torn + one.steps_back for one in reads), reads
    return (
        f"{writers} writers x {commits} commits, compaction, Gram job and vacuum beside them, "
        f"clocks a day apart: nothing lost or doubled, {seconds:.0f} s; {READERS} readers saw "
        f"{snapshots} snapshots, all whole, versions never went back"
    )
