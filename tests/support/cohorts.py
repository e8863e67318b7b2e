"""Cohorts made up in memory: the Gram rows of drives whose counts are known."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, timedelta

import numpy as np
import pyarrow as pa

from fleet_slip.catalogue.features import PLAIN
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohort import Cohort
from fleet_slip.grams.gram_files import hash_numbers
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.condition import parse_condition
from tests.support.counts import Matrix, table_of

LABEL = catalogue().label
INPUTS = ("ax", "ay", "yaw_rate", "steering_wheel")


@dataclass(frozen=True)
class Driven:
    """One Gram row to be: the counts of some signals, label last, and whose they are."""

    drive: str
    counts: Matrix
    signals: tuple[str, ...] = (*INPUTS, LABEL)
    part: str | None = None


def driven(
    seed: int,
    coefficients: Sequence[float],
    *,
    drives: int = 12,
    rows: int = 80,
    noise: float = 30.0,
    offset: float = 0.0,
    name: str = "d",
    part: str | None = None,
) -> list[Driven]:
    """Draw drives whose label is a known sum of the inputs, in counts, with noise of each drive."""
    rng = np.random.default_rng(seed)
    result = []
    for number in range(drives):
        x = np.rint(rng.normal(0, 400, (rows, len(coefficients))) + rng.normal(0, 100))
        of_drive = rng.normal(0, noise / 3)
        y = offset + x @ np.array(coefficients) + of_drive + rng.normal(0, noise, rows)
        counts = np.column_stack([x, np.rint(y)]).astype(np.int64)
        result.append(Driven(f"{name}{number:02d}", counts, part=part))
    return result


def cohort_of(
    drives: Sequence[Driven], *, feature_set: str = PLAIN, condition: str = "true"
) -> Cohort:
    """Return the cohort of drives that all have the same signals."""
    (signals,) = {one.signals for one in drives}
    table = table_of([Gram.from_counts(signals, one.counts) for one in drives])
    days = [date(2024, 5, 1) + timedelta(days=i % 3) for i in range(len(drives))]
    columns = {
        "drive_id": [one.drive for one in drives],
        "trip": [one.drive for one in drives],
        "source": ["simulated"] * len(drives),
        "signals": [",".join(signals)] * len(drives),
        "n": [len(one.counts) for one in drives],
        "vehicle_id": [f"car-{i % 4}" for i in range(len(drives))],
        "track": [f"track-{i % 2}" for i in range(len(drives))],
        "day": days,
        "mass_kg": [1200.0 + 100 * (i % 5) for i in range(len(drives))],
        "adhesion": [1.0 - 0.1 * (i % 3) for i in range(len(drives))],
        "part": pa.array([one.part for one in drives], pa.string()),
    }
    columns |= {
        f"{name}_hash": pa.array(hash_numbers(pa.array(columns[f"{name}_id"])))
        for name in ("drive", "vehicle")
    }
    return Cohort(
        condition=parse_condition(condition),
        tables=(table,),
        drives=pa.table(columns),
        logs_version=1,
        grams_version=1,
        feature_set=feature_set,
    )


def rows_of(drives: Sequence[Driven]) -> Matrix:
    """Return the counts of all drives, one below the other."""
    return np.concatenate([one.counts for one in drives])
