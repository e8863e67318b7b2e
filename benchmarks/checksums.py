"""What it costs that every job compares the data files that it reads with their checksums.

    python -m benchmarks.checksums [--campaign waterford] [--repeat 7]

Reading all columns, the Gram query and `score`, with the comparison and without it, in turn, in one
process; files lie in the page cache. The figure is the processor time of all threads, of which the
smallest counts, since other processes of the machine lengthen every other. The difference of two
such figures is uncertain by several per cent where the machine is busy; so the comparison of the
same files is measured by itself, too.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from fleet_slip.files import checksums
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.rows.aggregation import compute_grams
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.models.describe_winner import manifest_of
from fleet_slip.models.estimates.score import score
from fleet_slip.selection.answer_request import answer_request
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.simulation_job import simulate_campaign
from fleet_slip.warehouse.tables import Warehouse

SIGNALS = "ay,yaw_rate,steering_wheel,wheel_rl"


@contextmanager
def comparing(wanted: bool) -> Iterator[None]:
    """Compare every file anew, or none."""
    checksums._check_once.cache_clear()
    with mock.patch.object(checksums, "_check_once", checksums._check_once if wanted else _pass):
        yield


def _pass(*_: Any) -> None:
    """Compare nothing."""


def jobs(warehouse: Warehouse) -> dict[str, Callable[[], Any]]:
    """Return what is measured."""
    files = warehouse.logs.snapshot().files
    answer = answer_request(warehouse, SelectionRequest(nested=SIGNALS))
    manifest = manifest_of(answer, "measured")
    return {
        "read": lambda: [warehouse.logs.read(file.path).num_rows for file in files],
        "gram": lambda: list(compute_grams(warehouse, files)),
        "score": lambda: score(warehouse, manifest, "true"),
    }


def measure(job: Callable[[], Any], wanted: bool) -> float:
    """Return the processor time of a job, in seconds."""
    with comparing(wanted):
        started = time.process_time()
        job()
        return time.process_time() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--campaign", default="waterford")
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as threads:
        warehouse = Warehouse(LocalFolder(Path(folder)))
        campaign = load_campaign(options.campaign)
        simulate_campaign(warehouse, campaign, campaign.days(), threads)
        update_grams(warehouse)
        snapshot = warehouse.logs.snapshot()
        paths = [file.path for file in snapshot.files]

        def check() -> None:
            for path in paths:
                warehouse.logs.folder.check(path)

        print(f"{snapshot.rows:,} rows, {snapshot.size_bytes / 2**20:.0f} MiB")
        for name, job in jobs(warehouse).items():
            job()
            triples = [
                (measure(job, True), measure(job, False), measure(check, True))
                for _ in range(options.repeat)
            ]
            compared, plain, alone = (min(times) for times in zip(*triples, strict=True))
            print(
                f"{name:6s} {compared:.3f} s compared, {plain:.3f} s not: "
                f"{compared / plain - 1:+.1%}; comparing alone {alone:.3f} s, {alone / plain:.1%}"
            )


if __name__ == "__main__":
    main()
