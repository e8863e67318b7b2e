"""Makes the integer program of a published manifest, and checks that travel with it."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from io import StringIO

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import COUNT_MAX, SignalCatalog
from fleet_slip.columns.drive_columns import DriveCounts, compute_columns
from fleet_slip.export.program import UNKNOWN_CAR, Car, Input, Program, write_program
from fleet_slip.grams.compute import counts_of
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor


def compile_program(catalog: Catalog, manifest: Manifest) -> Program:
    """Return what a published version computes.

    Raises what `write_program` raises, and `QuestionError` or `DataError` for definitions that
    contradict each other.
    """
    # Raises for what the kernel could not compute.
    _ = Predictor.of(catalog.signals, manifest).plan.program
    return write_program(catalog, manifest)


# Checks of a program that travel with it: ticks of made-up drives, and the angles.
#
# No tick is of a drive of the warehouse: an export goes to people who may not see the logs.
# The angles come from the columns as the warehouse's kernel computes them, which knows nothing of
# programs, and from exact integers.

SMOOTH_TICKS = 300
HOSTILE_TICKS = 200

Sample = tuple[int | None, ...]
"""The counts of a tick in the order of the program's signals; None where missing."""


@dataclass(frozen=True)
class Check:
    """A drive, tick by tick from the first, and the angle at each; None where there is none.

    Attributes:
        name: what it is.
        known: facts of the car as logs have them.
        facts, numbers: what the car knows, in the order of the program; None where unknown.
        samples: of each tick.
        angles: counts of the program's angle.
    """

    name: str
    known: Mapping[str, object]
    facts: tuple[int | None, ...]
    numbers: tuple[int | None, ...]
    samples: tuple[Sample, ...]
    angles: tuple[int | None, ...]


def make_checks(signals: SignalCatalog, manifest: Manifest, program: Program) -> tuple[Check, ...]:
    """Return a smooth drive and hostile ones, each with the angle at every tick."""
    hostile = _hostile_car(program)
    drives: dict[str, tuple[Car, Iterable[Sample]]] = {
        "smooth": (UNKNOWN_CAR, _smooth(program)),
        "extremes": (hostile, _extremes(program, np.random.default_rng(1))),
        "holes": (UNKNOWN_CAR, _holes(program, np.random.default_rng(2))),
        "standstill": (hostile, _standstill(program, np.random.default_rng(3))),
    }
    return tuple(
        _check(signals, manifest, program, name, car, samples)
        for name, (car, samples) in drives.items()
    )


def angles_by_kernel(
    signals: SignalCatalog,
    manifest: Manifest,
    program: Program,
    car: Car,
    samples: Sequence[Sample],
) -> list[int | None]:
    """Return the angle of each tick, by the columns of the kernel and exact integers."""
    predictor = Predictor.of(signals, manifest)
    drive = drive_counts(program, predictor, car, samples)
    return angles_of_columns(program, compute_columns(predictor.plan, drive))


def drive_counts(
    program: Program, predictor: Predictor, car: Car, samples: Sequence[Sample]
) -> DriveCounts:
    """Return samples of consecutive ticks as a drive of the warehouse."""
    names = [one.name for one in program.signals]
    valid = [_valid(sample, program.signals) for sample in samples]
    counts = {
        name: pa.array(values, pa.int16())
        for name, values in zip(names, zip(*valid, strict=True), strict=True)
    }
    rows = pa.table({"tick": np.arange(len(samples), dtype=np.int64), **counts})
    facts = {name: car.facts.get(name) for name in predictor.plan.facts}
    return counts_of(rows, predictor.plan, facts, car.numbers)


def angles_of_columns(program: Program, columns: FloatArray) -> list[int | None]:
    """Return the angle of each row, given the columns of the terms, shape (terms, rows)."""
    angle = program.angle
    missing: BoolArray = np.any(np.isnan(columns), axis=0)
    whole = np.where(missing, 0.0, columns).astype(np.int64).astype(object)
    total = np.full(columns.shape[1], angle.intercept + (1 << (angle.bits - 1)), dtype=object)
    for (_, coefficient), column in zip(angle.terms, whole, strict=True):
        total += coefficient * column
    rounded = [max(-angle.limit, min(angle.limit, int(one >> angle.bits))) for one in total]
    return [None if gone else one for one, gone in zip(rounded, missing, strict=True)]


def _valid(sample: Sample, signals: Sequence[Input]) -> Sample:
    """Return a sample in which counts beyond the valid range are missing."""
    return tuple(
        count if count is not None and one.min_count <= count <= one.max_count else None
        for count, one in zip(sample, signals, strict=True)
    )


def _check(
    signals: SignalCatalog,
    manifest: Manifest,
    program: Program,
    name: str,
    car: Car,
    samples: Iterable[Sample],
) -> Check:
    ticks = tuple(samples)
    angles = tuple(angles_by_kernel(signals, manifest, program, car, ticks))
    counts = car.fact_counts(program), car.number_counts(program)
    return Check(name, car.facts, *counts, ticks, angles)


def _smooth(program: Program) -> Iterable[Sample]:
    """Yield a drive of whole counts without holes: every signal swings with a period of its own."""
    for tick in range(SMOOTH_TICKS):
        yield tuple(_swing(one, tick, 60 + 14 * i) for i, one in enumerate(program.signals))


def _swing(signal: Input, tick: int, period: int) -> int:
    """Return a count at a tick of a triangle that is an eighth of the range high."""
    height = (signal.max_count - signal.min_count) // 8
    middle = (signal.min_count + signal.max_count) // (4 if signal.min_count >= 0 else 2)
    distance = abs(2 * (tick % period) - period)  # from the middle of the period, 0 to `period`
    return middle + height * distance // period - height // 2


def _hostile_car(program: Program) -> Car:
    """Return a car whose facts and numbers are far from usual."""
    facts = {one.name: 2**16 if one.equals is None else one.equals for one in program.facts}
    numbers = {
        one.name: COUNT_MAX if place % 2 else -COUNT_MAX
        for place, one in enumerate(program.numbers)
    }
    return Car(facts, numbers)


def _extremes(program: Program, random: np.random.Generator) -> Iterable[Sample]:
    """Yield ends of the ranges, all at once and one by one, and what is just beyond them."""
    for tick in range(HOSTILE_TICKS):
        if tick % 40 < 10:
            high = tick % 80 < 40
            yield tuple(one.max_count if high else one.min_count for one in program.signals)
        else:
            yield tuple(_extreme(one, random) for one in program.signals)


def _extreme(one: Input, random: np.random.Generator) -> int | None:
    within = (one.min_count, one.max_count, -1, 0, 1, one.max_count // 2)
    beyond = (one.min_count - 1, one.max_count + 1, None)
    if random.random() < 0.98:
        return within[random.integers(len(within))]
    return beyond[random.integers(len(beyond))]


def _holes(program: Program, random: np.random.Generator) -> Iterable[Sample]:
    """Yield a drive that lacks ticks, long and short, and single values."""
    gone = 0
    for _ in range(HOSTILE_TICKS):
        begins = random.random() < 0.05
        gone = gone - 1 if gone else (1, 2, 30)[random.integers(3)] if begins else 0
        yield tuple(
            None
            if gone or random.random() < 0.01
            else int(random.integers(0, one.max_count // 4 + 1))
            for one in program.signals
        )


def _standstill(program: Program, random: np.random.Generator) -> Iterable[Sample]:
    """Yield a start from standstill: no feature that divides by speed has a value at first."""
    for tick in range(HOSTILE_TICKS):
        yield tuple(
            int(random.integers(-2, 3)) + one.max_count * tick // (8 * HOSTILE_TICKS)
            for one in program.signals
        )


def checks_csv(program: Program, checks: Sequence[Check]) -> str:
    """Return CSV with a row a tick: columns as the statement of SQL reads them, and the angle.

    An empty cell is a missing value, or no angle.
    """
    facts = tuple(dict.fromkeys(one.name for one in program.facts))
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [one.column for one in program.signals]
    numbers = [one.name for one in program.numbers]
    writer.writerow(["drive_id", "tick", *columns, *facts, *numbers, "expected_angle"])
    for check in checks:
        known = [check.known.get(name) for name in facts]
        known += [
            _physical(count, one.grain)
            for count, one in zip(check.numbers, program.numbers, strict=True)
        ]
        for tick, (sample, angle) in enumerate(zip(check.samples, check.angles, strict=True)):
            values = [
                _physical(count, one.scale)
                for count, one in zip(sample, program.signals, strict=True)
            ]
            writer.writerow([check.name, tick, *values, *known, angle])
    return text.getvalue()


def _physical(count: int | None, scale: Decimal) -> str | None:
    return None if count is None else f"{count * scale:f}"
