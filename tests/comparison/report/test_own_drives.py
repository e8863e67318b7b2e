"""Evaluation and report of a model of drives without wheel speeds, steering and navigation."""

import math
import random
import shutil
from pathlib import Path

import pytest

from tests.support.commands import Finished, done_on
from tests.support.measured import csv_text
from tests.support.reported import Reported

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


def log_of(cars: int, rows: int = 500) -> str:
    rng = random.Random(5)  # noqa: S311
    ticks = [(car, tick) for car in range(cars) for tick in range(rows)]
    ay = [3 * math.sin(tick / 30) + rng.gauss(0, 0.05) for _, tick in ticks]
    return csv_text(
        {
            "t": [tick / 100 for _, tick in ticks],
            "car": [f"car-{car}" for car, _ in ticks],
            "ax": [rng.gauss(0, 0.3) for _ in ticks],
            "ay": ay,
            "r": [value / 20 for value in ay],
            "beta": [-value / 200 + rng.gauss(0, 0.0003) for value in ay],
        }
    )


@pytest.fixture(scope="module")
def evaluated(
    reported: Reported, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Finished]:
    """A data root with a model of such drives, and what its evaluation said."""
    folder = tmp_path_factory.mktemp("own")
    root = Path(shutil.copytree(reported.root, folder / "data"))
    (folder / "log.csv").write_text(log_of(cars=5))
    (folder / "own.toml").write_text(MAPPING)
    done_on(root, "ingest", folder / "log.csv", "--mapping", folder / "own.toml")
    done_on(root, "gram")
    done_on(root, "publish", "own", "--cohort", "source = 'measured'")
    return root, done_on(root, "evaluate", "own", "--scenario", "nominal")


def test_who_cannot_be_tuned_says_so_in_a_line_and_competes(
    evaluated: tuple[Path, Finished],
) -> None:
    _, done = evaluated
    assert "kalman competes as it is, for it cannot be tuned: the drive has no GPS" in done.stderr
    assert "ekf_class competes as it is" in done.stderr
    assert "nominal" in done.stdout


def test_the_report_has_what_is_left(evaluated: tuple[Path, Finished]) -> None:
    root, _ = evaluated
    done_on(root, "evaluate", "own", "--cohort", "source = 'measured'")
    done_on(root, "report", "own")
    page = (root / "report" / "report.html").read_text()
    assert "A car of one&#39;s own: measured drives" in page
    assert "on the nominal drive; of model 1" in page
    assert "lack signals of model 2, 3, 4 and 5 of Table I" in page
