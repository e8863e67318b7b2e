"""Logs of cars of one's own: accelerations, yaw rate and side-slip angle, and no other signal."""

import math
import random
from pathlib import Path

from tests.support.commands import done_on
from tests.support.measured import csv_text

MAPPING = """
name = "own"
[time]
column = "t"
unit = "s"
[drive]
vehicle_id = { column = "car" }
vehicle_model = "own"
day = 2026-05-04
[signals]
ax = { column = "ax", unit = "m/s^2" }
ay = { column = "ay", unit = "m/s^2" }
yaw_rate = { column = "r", unit = "rad/s" }
sideslip = { column = "beta", unit = "rad" }
"""


def ingest_own(root: Path, folder: Path, cars: int) -> None:
    """Write a log of five seconds of each car, `car-0` and so on, and ingest it."""
    rng = random.Random(5)  # noqa: S311
    ticks = [(car, tick) for car in range(cars) for tick in range(500)]
    ay = [3 * math.sin(tick / 30) + rng.gauss(0, 0.05) for _, tick in ticks]
    columns = {
        "t": [tick / 100 for _, tick in ticks],
        "car": [f"car-{car}" for car, _ in ticks],
        "ax": [rng.gauss(0, 0.3) for _ in ticks],
        "ay": ay,
        "r": [value / 20 for value in ay],
        "beta": [-value / 200 + rng.gauss(0, 0.0003) for value in ay],
    }
    (folder / "log.csv").write_text(csv_text(columns))
    (folder / "own.toml").write_text(MAPPING)
    done_on(root, "ingest", folder / "log.csv", "--mapping", folder / "own.toml")
    done_on(root, "gram")
