"""The time of `simulate` by stage.

    python -m benchmarks.simulator_profile [--campaign fleet_realistic]

One file of a campaign, time of the processor on one thread, the best of several rounds.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import durations
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Batch, load_campaign
from fleet_slip.simulation.sensors import measure
from fleet_slip.simulation.simulate import lane_drive, simulate_logs, tabulate
from fleet_slip.storage.data_files import checksum_of
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.batch import LaneDrive, simulate_drives
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS

ROUNDS = 5


def best(function: Callable[[], Any]) -> float:
    """Return the shortest time of some calls, in s."""
    return min(durations(function, ROUNDS, time.thread_time))


def drive(drives: list[LaneDrive]) -> None:
    """Run the kernel and drop what it says."""
    for _ in simulate_drives(drives):
        pass


def stages(batch: Batch, warehouse: Warehouse) -> tuple[int, dict[str, float]]:
    """Return the rows of a batch and the seconds of each stage on its way to the logs."""
    lanes = [lane_drive(spec) for spec in batch.drives]
    logs = simulate_logs(SIGNALS, batch.drives)
    rows = tabulate(SIGNALS, batch, logs)
    signals = [name for name in SIGNALS.signals if name in rows.schema.names]
    truths = [(batch.drives[t.drive], t.channels) for t in simulate_drives(lanes)]

    def record() -> None:
        for spec, truth in truths:
            measure(SIGNALS, spec.sensors, spec.generator("sensors"), spec.distorted(truth))

    def distort() -> None:
        for spec, truth in truths:
            spec.distorted(truth)

    noise = np.empty(len(rows), dtype=np.float32)
    generator = batch.drives[0].generator("sensors")
    noisy = len(batch.drives[0].sensors.bias_and_std)
    encoded = warehouse.logs.encode(rows)
    draw_s = noisy * best(lambda: generator.standard_normal(out=noise, dtype=np.float32))
    distort_s = best(distort)
    remaining = [name for name in rows.schema.names if name not in signals]
    return len(rows), {
        "plan a day: cars, roads, speeds": best(
            lambda: load_campaign(batch.campaign, SHIPPED_CONFIGS).batches(batch.day)
        ),
        "roads of the drives": best(lambda: [lane_drive(spec) for spec in batch.drives]),
        "kernel": best(lambda: drive(lanes)),
        "sensors: draw the noise": draw_s,
        "sensors: imperfections": distort_s,
        "sensors: add it, round, clip": best(record) - draw_s - distort_s,
        "tabulate": best(lambda: tabulate(SIGNALS, batch, logs)),
        "encode: signals": best(lambda: warehouse.logs.encode(rows.select(signals))),
        "encode: tick and metadata": best(lambda: warehouse.logs.encode(rows.select(remaining))),
        "checksum (again in encode)": best(lambda: checksum_of(encoded.content)),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--campaign", default="fleet")
    arguments = parser.parse_args()
    campaign = load_campaign(arguments.campaign, SHIPPED_CONFIGS)
    batch = campaign.batches(campaign.first_day)[0]
    with tempfile.TemporaryDirectory() as folder:
        rows, seconds = stages(batch, Warehouse(LocalFolder(Path(folder))))
    print(f"{rows:,} rows of {len(batch.drives)} drives\n{'stage':34}{'ms':>8}{'ns a row':>10}")
    for name, spent in seconds.items():
        print(f"{name:34}{1e3 * spent:8.0f}{1e9 * spent / rows:10.1f}")
    measured = [spent for name, spent in seconds.items() if "(" not in name]
    print(f"{'together':34}{1e3 * sum(measured):8.0f}{1e9 * sum(measured) / rows:10.1f}")


if __name__ == "__main__":
    main()
