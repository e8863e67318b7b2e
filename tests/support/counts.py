"""Data, cohorts made up in memory, outside answers, and float64 formulas to compare with."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from fractions import Fraction
from math import ceil, floor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.catalog.features import PLAIN
from fleet_slip.grams.cohort import Cohort, hash_names
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.regression.least_squares import fit
from fleet_slip.warehouse.database import parse_predicate
from tests.support.catalog import CATALOG, SIGNALS

Matrix = NDArray[Any]


def nearest(value: Fraction) -> int:
    """Round to the nearest integer, halves away from zero."""
    return floor(value + Fraction(1, 2)) if value >= 0 else ceil(value - Fraction(1, 2))


def columns_to_counts(rows: list[list[str]]) -> tuple[Matrix, list[Fraction]]:
    """Turn decimal strings into integer counts and the scale of each column."""
    exact = [[Fraction(value) for value in column] for column in zip(*rows, strict=True)]
    scales = []
    for column in exact:
        places = 0
        while any((value * 10**places).denominator != 1 for value in column):
            places += 1
        scales.append(Fraction(1, 10**places))
    counts = [
        [int(value / scale) for value in column]
        for column, scale in zip(exact, scales, strict=True)
    ]
    return np.array(counts, dtype=object).T, scales


def random_drives(
    seed: int, drives: int = 12, rows: int = 60, inputs: int = 4, noise: float = 30.0
) -> list[Matrix]:
    """Return counts of drives whose last column depends on the others, with drive effects."""
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(inputs, inputs)) + 2 * np.eye(inputs)
    weights = rng.normal(size=inputs)
    result = []
    for _ in range(drives):
        x = rng.normal(size=(rows, inputs)) @ mix * 300 + rng.normal(size=inputs) * 100
        y = x @ weights + rng.normal() * noise + rng.normal(size=rows) * noise
        result.append(np.rint(np.column_stack([x, y])).astype(np.int64))
    return result


def names(inputs: int) -> tuple[str, ...]:
    """Return x1, x2, ..., y."""
    return (*(f"x{i + 1}" for i in range(inputs)), "y")


def gram_of(counts: Matrix) -> Gram:
    """Return the Gram of counts, label last."""
    return Gram.from_counts(names(counts.shape[1] - 1), counts)


def table_of(grams: Sequence[Gram]) -> GramTable:
    """Stack the Grams of drives."""
    return GramTable(
        grams[0].signals,
        np.array([gram.n for gram in grams], dtype=np.int64),
        np.array([gram.sums for gram in grams], dtype=np.int64),
        np.array([gram.products for gram in grams], dtype=np.int64),
    )


def dense_fit(counts: Matrix) -> tuple[Matrix, float]:
    """Return (intercept, coefficients) and the residual sum of squares from rows (float64 QR)."""
    x = np.column_stack([np.ones(len(counts)), counts[:, :-1]]).astype(float)
    y = counts[:, -1].astype(float)
    solution = np.linalg.lstsq(x, y, rcond=None)[0]
    return solution, float(np.sum((y - x @ solution) ** 2))


def unit_scales(inputs: int) -> dict[str, Fraction]:
    """Return the scale 1 for x1, x2, ..., y."""
    return dict.fromkeys(names(inputs), Fraction(1))


def greedy_order(gram: Gram, method: str) -> tuple[str, ...]:
    """Return the order of a Gram's inputs, label last, by exact sums of squares at each step."""
    *inputs, label = gram.signals

    def rss(chosen: Iterable[str]) -> Fraction:
        return fit(gram, [*chosen], label).rss

    order: list[str] = []
    while candidates := [name for name in inputs if name not in order]:
        if method == "forward":
            order.append(min(candidates, key=lambda name: rss([*order, name])))
        else:  # of equals the later
            without = {
                name: rss(n for n in candidates if n != name) for name in reversed(candidates)
            }
            order.append(min(without, key=lambda name: without[name]))
    return tuple(order if method == "forward" else reversed(order))


def drives_of(
    random: np.random.Generator,
    clusters: int,
    inputs: int,
    *,
    rows: float = 30,
    spread: float = 0.3,
) -> list[Matrix]:
    """Draw the rows of unequal clusters, whose coefficients differ by `own`."""
    drives = []
    for _ in range(clusters):
        many = int(rows * np.exp(0.6 * random.normal())) + inputs + 2
        x = random.normal(size=(many, inputs)) * np.exp(0.3 * random.normal(size=inputs))
        x += 0.3 * random.normal(size=inputs)
        b = 1 + spread * random.normal(size=inputs)
        y = x @ b + spread * random.normal() + random.normal(size=many)
        drives.append(np.rint(1000 * np.column_stack([x, y])).astype(np.int64))
    return drives


def by_rows(clusters: Sequence[Matrix], *, intercept: bool = True) -> tuple[Matrix, Matrix]:
    """CR2 errors and Satterthwaite's degrees of freedom from n x n matrices.

    Bell and McCaffrey (2002), and equation (11) of Imbens and Kolesar (2016).
    """
    rows = np.concatenate(clusters).astype(float)
    x, y = rows[:, :-1], rows[:, -1]
    if intercept:
        x = np.column_stack([np.ones(len(rows)), x])
    unit = np.sqrt((x**2).mean(axis=0))
    x = x / unit
    bread = np.linalg.inv(x.T @ x)
    residual_maker = np.eye(len(x)) - x @ bread @ x.T
    cluster_of_row = np.repeat(np.arange(len(clusters)), [len(part) for part in clusters])
    moves = []
    for number in range(len(clusters)):
        mask = cluster_of_row == number
        values, vectors = np.linalg.eigh(residual_maker[np.ix_(mask, mask)])
        moves.append(
            bread @ x[mask].T @ (vectors / np.sqrt(values)) @ vectors.T @ residual_maker[mask]
        )
    effects = np.array(moves)  # (clusters, coefficients, rows): what is squared, of the label
    errors = np.sqrt(((effects @ y) ** 2).sum(axis=0)) / unit
    covariances = np.einsum("gjn,hjn->jgh", effects, effects)
    traces = np.einsum("jgg->j", covariances)
    return errors, traces**2 / (covariances**2).sum(axis=(1, 2))


EVIDENCE = Path(__file__).parents[1] / "evidence"


def evidence(path: str) -> Any:
    """Load a JSON file of outside answers."""
    return json.loads((EVIDENCE / path).read_text(encoding="utf-8"))


LABEL = SIGNALS.label
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
    drives: Sequence[Driven], *, feature_set: str = PLAIN, predicate: str = "true"
) -> Cohort:
    """Return the cohort of drives that all have the same signals."""
    (signals,) = {drive.signals for drive in drives}
    table = table_of([Gram.from_counts(signals, drive.counts) for drive in drives])
    days = [date(2024, 5, 1) + timedelta(days=i % 3) for i in range(len(drives))]
    columns = {
        "drive_id": [drive.drive for drive in drives],
        "trip": [drive.drive for drive in drives],
        "source": ["simulated"] * len(drives),
        "signals": [",".join(signals)] * len(drives),
        "n": [len(drive.counts) for drive in drives],
        "vehicle_id": [f"car-{i % 4}" for i in range(len(drives))],
        "track": [f"track-{i % 2}" for i in range(len(drives))],
        "day": days,
        "mass_kg": [1200.0 + 100 * (i % 5) for i in range(len(drives))],
        "adhesion": [1.0 - 0.1 * (i % 3) for i in range(len(drives))],
        "part": pa.array([drive.part for drive in drives], pa.string()),
    }
    columns |= {
        f"{name}_hash": pa.array(hash_names(pa.array(columns[f"{name}_id"])))
        for name in ("drive", "vehicle")
    }
    return Cohort(
        predicate=parse_predicate(SIGNALS, predicate),
        tables=(table,),
        drives=pa.table(columns),
        logs_version=1,
        grams_version=1,
        feature_set=feature_set,
        catalog=CATALOG,
    )


def rows_of(drives: Sequence[Driven]) -> Matrix:
    """Return the counts of all drives, one below the other."""
    return np.concatenate([drive.counts for drive in drives])
