"""Logs of cars of one's own: accelerations, yaw rate and side-slip angle, and no other signal."""

import math
import random
from pathlib import Path
from typing import Any

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


def own_columns(rng: random.Random, slip: float = -1.0) -> dict[str, list[Any]]:
    """Five seconds of a car on bends."""
    ay = [3 * math.sin(tick / 30) + rng.gauss(0, 0.05) for tick in range(500)]
    return {
        "t": [tick / 100 for tick in range(500)],
        "ax": [rng.gauss(0, 0.3) for _ in ay],
        "ay": ay,
        "r": [value / 20 for value in ay],
        "beta": [slip * value / 200 + rng.gauss(0, 0.0003) for value in ay],
    }


def ingest_own(root: Path, folder: Path, cars: int) -> None:
    """Write a log of each car, `car-0` and so on, and ingest it."""
    rng = random.Random(5)  # noqa: S311
    logs = [own_columns(rng) | {"car": [f"car-{car}"] * 500} for car in range(cars)]
    columns = {name: [value for log in logs for value in log[name]] for name in logs[0]}
    (folder / "log.csv").write_text(csv_text(columns))
    (folder / "own.toml").write_text(MAPPING)
    done_on(root, "ingest", folder / "log.csv", "--mapping", folder / "own.toml")
    done_on(root, "gram")
