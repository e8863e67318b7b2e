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
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.grams.job import update_grams
from fleet_slip.operations.forget import forget
from fleet_slip.operations.rewriting import compact
from fleet_slip.operations.verify import read_whole, verify
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.job import simulate_campaign
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.forgotten import Forgettable
from fleet_slip.warehouse.tables import Warehouse
from tests.support.writers import concurrency

PATIENCE_S = 3600.0
CAMPAIGNS = {"waterford": None, "fleet": 7}
"""The warehouse that bits are flipped in: campaigns, and how many of their days."""


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
        found += read_whole(table, file).problem is not None
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
    print(concurrency(options.writers, options.commits, PATIENCE_S), flush=True)
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
