"""Simulation and Gram rows by threads of one process, and by the workers of a Dask cluster.

    python -m benchmarks.cluster [--days 6] [--workers 2]

Both run the first days of the campaign `fleet` on this machine, with as many threads as the cluster
has workers of one thread, and are timed after a first batch has warmed them up. Whether both wrote
the same bits is checked: the names of data files carry their checksums.
"""

import argparse
import tempfile
from concurrent.futures import Executor
from pathlib import Path

from benchmarks.harness import durations, peak_bytes
from fleet_slip.compute.cluster import cluster_executor
from fleet_slip.compute.tasks import LocalThreads
from fleet_slip.grams.update import update_grams
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.simulate import simulate_campaign
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.dask_processes import dask_processes

WARM_UP = "smoke"


def measure(
    root: Path, campaign: Campaign, days: int, executor: Executor, elsewhere: Executor | None
) -> tuple[float, float]:
    """Return the time to simulate and the time for the Gram rows, in s."""
    warm = load_campaign(WARM_UP, SHIPPED_CONFIGS)
    other = Warehouse(LocalFolder(root.with_name(f"{root.name}-warm")))
    simulate_campaign(other, warm, warm.days(), executor)
    update_grams(other, executor=elsewhere)
    warehouse = Warehouse(LocalFolder(root))
    chosen = campaign.days()[:days]
    (simulate_s,) = durations(
        lambda: simulate_campaign(warehouse, campaign, chosen, executor), rounds=1
    )
    (gram_s,) = durations(lambda: update_grams(warehouse, executor=elsewhere), rounds=1)
    return simulate_s, gram_s


def data_files(root: Path) -> set[str]:
    """Return the names of all data files."""
    return {str(file.relative_to(root)) for file in root.rglob("*.parquet")}


def main() -> None:
    """Measure both, and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=int, default=6)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    campaign = load_campaign("fleet", SHIPPED_CONFIGS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        local_folder, cluster_folder = folder / "here", folder / "there"
        with LocalThreads(arguments.workers) as threads:
            local = measure(local_folder, campaign, arguments.days, threads, None)
        with dask_processes(folder, arguments.workers) as dask:
            dask.wait_for_workers(arguments.workers)
            with cluster_executor(dask.address, LocalFolder(folder)) as executor:
                cluster = measure(cluster_folder, campaign, arguments.days, executor, executor)
            memory = max(peak_bytes(process.pid) for process in dask.processes[1:])
        assert data_files(local_folder) == data_files(cluster_folder), "the bits differ"
        rows = Warehouse(LocalFolder(local_folder)).logs.snapshot().rows
    print(f"{rows:,} rows; the same bits from {arguments.workers} threads and from Dask workers")
    for step, ours, theirs in zip(("simulate", "gram"), local, cluster, strict=True):
        print(
            f"{step:10s} threads {ours:6.2f} s, {rows / ours / 1e6:6.2f} Mrows/s   "
            f"cluster {theirs:6.2f} s, {rows / theirs / 1e6:6.2f} Mrows/s   "
            f"ratio {ours / theirs:.2f}"
        )
    print(f"a worker of one thread held at most {memory / 2**20:.0f} MiB")


if __name__ == "__main__":
    main()
