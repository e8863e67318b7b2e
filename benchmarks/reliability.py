"""Writers and readers at once, flipped bits, and what verifying and forgetting cost.

    python -m benchmarks.reliability [--writers 8] [--commits 50] [--bits 200]

Every figure comes from doing the harm for real; a figure that is not what it must be is an error.
"""

import argparse
import multiprocessing
import os
import random
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Change, Table, Unit, retry_conflicts
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.job import update_grams
from fleet_slip.maintenance.audit import Forgettable
from fleet_slip.maintenance.compaction import compact
from fleet_slip.maintenance.forget import forget
from fleet_slip.maintenance.vacuum import vacuum
from fleet_slip.maintenance.verify import verify
from fleet_slip.maintenance.verify_files import problem_of
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.job import simulate_campaign
from fleet_slip.warehouse.tables import Warehouse

DAY = date(2024, 5, 1)
ROWS = 20
FILES_OF_A_COMMIT = 2
READERS = 2
HOST_CLOCKS_APART_S = 86_400.0
CAMPAIGNS = {"waterford": None, "fleet": 7}
"""The warehouse that bits are flipped in: campaigns, and how many of their days."""


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


def concurrency(writers: int, commits: int) -> None:
    """Let writers, a rearranging job and readers work at once; count what went wrong."""
    context = multiprocessing.get_context("spawn")
    stop, answer = context.Event(), context.Queue()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        started = time.monotonic()
        working = [
            context.Process(target=write, args=(root, writer, commits)) for writer in range(writers)
        ]
        watching = [context.Process(target=read, args=(root, stop, answer)) for _ in range(READERS)]
        watching.append(context.Process(target=rearrange, args=(root, stop)))
        for process in (*working, *watching):
            process.start()
        for process in working:
            process.join()
        seconds = time.monotonic() - started
        stop.set()
        reads = [answer.get() for _ in range(READERS)]
        for process in (*working, *watching):
            process.join()
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
    print(
        f"{writers} writers x {commits} commits, compaction, Gram job and vacuum beside them, "
        f"clocks a day apart: nothing lost or doubled, {seconds:.0f} s; {READERS} readers saw "
        f"{snapshots} snapshots, all whole, versions never went back",
        flush=True,
    )


def bits(warehouse: Warehouse, count: int) -> None:
    """Flip bits, one at a time, anywhere in the data files; each must be found."""
    rng = random.Random(0)  # noqa: S311
    files = [(table, file) for table in warehouse.tables for file in table.snapshot().files]
    weights = [file.size_bytes for _, file in files]
    found = 0
    for table, file in rng.choices(files, weights, k=count):
        path = Path(table.uri(file.path))
        bit = rng.randrange(file.size_bytes * 8)
        _flip(path, bit)
        found += problem_of(table, file) is not None
        _flip(path, bit)
    assert not verify(warehouse).damage
    print(f"{count} bits flipped in {len(files)} files: {found} found", flush=True)
    assert found == count


def _flip(path: Path, bit: int) -> None:
    with path.open("r+b") as file:
        file.seek(bit // 8)
        byte = file.read(1)[0]
        file.seek(bit // 8)
        file.write(bytes([byte ^ 1 << bit % 8]))


def verifying(root: Path, full: bool) -> tuple[float, int, int]:
    """Verify a root; return seconds, rows, and the most memory that this process ever had."""
    started = time.perf_counter()
    report = verify(Warehouse(LocalFolder(root)), full=full)
    seconds = time.perf_counter() - started
    assert not report.findings
    return seconds, report.rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def in_a_process_of_its_own(root: Path, full: bool) -> tuple[float, int, int]:
    """Verify in a new process, whose memory nothing else has used."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        return executor.submit(verifying, root, full).result()


def costs(warehouse: Warehouse, root: Path) -> None:
    """Time verify, forget and compact."""
    size = warehouse.logs.snapshot().size_bytes + warehouse.grams.snapshot().size_bytes
    for full in (False, True):
        seconds, rows, memory = in_a_process_of_its_own(root, full)
        print(
            f"verify{' --full' if full else ''}: {seconds:.2f} s for {size / 1e6:.1f} MB "
            f"({rows:,} rows), {seconds / size * 1e9:.0f} s/GB; {memory / 2**20:.0f} MiB of "
            "memory at most",
            flush=True,
        )
    rows = pq.read_table(
        warehouse.grams.snapshot().paths[0], columns=["drive_id", "vehicle_id", "campaign"]
    )
    one, other, *_ = rows.filter(pc.equal(rows["campaign"], "fleet")).to_pylist()
    for subject in (
        Forgettable("drive", one["drive_id"]),
        Forgettable("vehicle", other["vehicle_id"]),
    ):
        started = time.perf_counter()
        done = forget(warehouse, subject, now=True)
        seconds = time.perf_counter() - started
        print(
            f"forget --{subject.kind} {subject.value} --now: {seconds:.2f} s, {done.drives} drives "
            f"with {done.rows:,} rows in {done.files_rewritten} files; {done.old_files_deleted} "
            "old files deleted",
            flush=True,
        )
    assert not verify(warehouse, full=True).damage
    started = time.perf_counter()
    compacted = compact(warehouse)
    seconds = time.perf_counter() - started
    print(
        f"compact: {compacted.rows_rewritten:,} rows, {compacted.files_before} files to "
        f"{compacted.files_after}, {seconds:.2f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--writers", type=int, default=8)
    parser.add_argument("--commits", type=int, default=50)
    parser.add_argument("--bits", type=int, default=200)
    options = parser.parse_args()
    concurrency(options.writers, options.commits)
    with tempfile.TemporaryDirectory() as folder:
        warehouse = Warehouse(LocalFolder(Path(folder)))
        for name, days in CAMPAIGNS.items():
            campaign = load_campaign(name)
            with ThreadPoolExecutor(os.cpu_count()) as executor:
                simulate_campaign(warehouse, campaign, campaign.days()[:days], executor)
        update_grams(warehouse)
        bits(warehouse, options.bits)
        costs(warehouse, Path(folder))


if __name__ == "__main__":
    main()
