"""A program in Python, tick by tick, for test benches (`Fleet.estimator`), and its test vectors."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from io import StringIO
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.arithmetic import COMPUTED, nearest
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import round_number
from fleet_slip.catalog.signals import COUNT_MAX, SignalCatalog
from fleet_slip.columns.drive_columns import DriveCounts, compute_columns
from fleet_slip.columns.lowering import power
from fleet_slip.errors import InputError, RefusedError
from fleet_slip.export.program import Input, Program, write_program
from fleet_slip.grams.compute import counts_of
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor

_OPERATIONS: Mapping[str, Callable[..., int | None]] = {
    **COMPUTED,
    "constant": lambda value: value,
    "nearest": lambda a, b: nearest(a, b) if b > 0 else None,
    "shift": lambda a, bits: nearest(a, 1 << bits),
    "min": min,
    "max": max,
    "power": power,
    "clip": lambda a, limit: max(-limit, min(a, limit)),
    "at_least": lambda a, bound: a if a >= bound else None,
    "where": lambda a, _: a,
    "next": lambda a, _: a,
}
"""Operations on values of one tick, none of which is missing, and on plain numbers."""

Sample = tuple[int | None, ...]
"""The counts of a tick in the order of the program's signals; None where missing."""

RETAINED_PARTS = 256
"""Parts of the sums of a drive that can be retained for the next drive."""


class Estimator:
    """Estimates the side-slip angle of a drive, sample by sample.

    Parameters
    ----------
    catalog
        Signals and features.
    manifest
        Manifest of the version.
    car
        Properties of the car: facts, and numbers in SI units, by name.

    Attributes
    ----------
    columns
        Columns in SI units that a sample must have.
    car
        Counts of the car's facts and numbers, in the order of the program.

    Raises
    ------
    InputError
        If the version does not use a property of the car.
    """

    def __init__(
        self, catalog: Catalog, manifest: Manifest, car: Mapping[str, Any] | None = None
    ) -> None:
        self._manifest = manifest = manifest.estimate
        self._program = program = compile_program(catalog, manifest)
        self.car = _car_counts(manifest, program, car or {})
        self.columns = tuple(signal.column for signal in program.signals)
        scale_of = {signal.name: float(signal.scale) for signal in program.signals}
        self._terms = [
            (place, scale_of[t.signal] if t.logged else float(t.scale), t.coefficient)
            for t, place in zip(manifest.terms, program.angle.places, strict=True)
        ]
        self._windows: dict[tuple[int, ...], list[int]] = {}
        self.restart()

    def step(self, sample: Mapping[str, float | None]) -> float | None:
        """Estimate the angle at the next tick.

        The angles of a drive have the same bits as those of `predict`.

        Parameters
        ----------
        sample
            Values of `columns` in SI units. None, or a value outside the valid range, is missing.
            Other keys are ignored. Values are rounded to counts, halves to even.

        Returns
        -------
        float or None
            Angle in rad; None if a column of the model is missing.

        Raises
        ------
        InputError
            If the sample lacks a column.
        """
        now = self.advance(self._counts(sample))
        estimate = self._manifest.intercept
        for place, scale, coefficient in self._terms:
            count = now[place]
            if count is None:
                return None
            estimate += coefficient * (count * scale)
        return estimate

    def advance(self, counts: Sample) -> list[int | None]:
        """Advance by a tick with these counts of the signals; return the value of each step."""
        inputs = {**self.car, "signal": valid_counts(counts, self._program.signals)}
        now: list[int | None] = []
        for name, operands, plain in self._program.steps:
            values = [now[operand] for operand in operands]
            if name in _OPERATIONS:
                now.append(None if None in values else _OPERATIONS[name](*values, *plain))
            elif name in inputs:
                now.append(inputs[name][plain[0]])
            elif name == "else":
                now.append(values[1] if values[0] is None else values[0])
            elif name == "state":
                now.append(self._states[len(now)])
            elif name == "ago":
                now.append(self._ago(*operands, *plain))
            else:
                now.append(self._slide(name, values[0], *operands, *plain))
        for source, ring in self._rings.items():
            ring[self._tick % len(ring)] = now[source]
        for state, following in self._program.states.items():
            self._states[state] = now[following] or 0
        self._tick += 1
        return now

    @property
    def states(self) -> tuple[int, ...]:
        """States of the filter after the last tick, in the order of the program's steps."""
        return tuple(self._states.values())

    def skip(self, ticks: int = 1) -> None:
        """Advance by ticks without a message."""
        empty = dict.fromkeys(self.columns)
        for _ in range(min(ticks, self._program.longest_ticks + 1)):  # then the history is empty
            self.step(empty)

    def restart(self, retained: int = 0) -> None:
        """Start another drive of the same car.

        Parameters
        ----------
        retained
            Parts of 256 of the sums that slopes are computed from, as in `next` of the C export.

        Raises
        ------
        InputError
            If `retained` is not from 0 to 256.
        """
        if not 0 <= retained <= RETAINED_PARTS:
            raise InputError(f"retained = {retained}: choose 0 to {RETAINED_PARTS} parts.")
        previous = self._windows
        self._tick = 0
        self._states = dict.fromkeys(self._program.states, 0)
        rings = self._program.rings.items()
        self._rings: dict[int, list[int | None]] = {place: [None] * n for place, n in rings if n}
        self._windows = {window: [0, 0] for window in self._program.sums}
        for window in self._program.learned if previous else ():
            values = [value * retained // RETAINED_PARTS for value in previous[window]]
            self._windows[window] = values

    def _counts(self, sample: Mapping[str, float | None]) -> Sample:
        """Round a sample to counts; None: missing."""
        name, counts = self._manifest.name, list[int | None]()
        if missing := [column for column in self.columns if column not in sample]:
            raise InputError(f"{name} needs {', '.join(missing)} in every sample.")
        for signal in self._program.signals:
            value = sample[signal.column]
            try:
                ratio = float("nan") if value is None else float(value) / float(signal.scale)
            except (TypeError, ValueError):
                raise InputError(
                    f"{name}: {signal.column} of a sample is not a number. Give a number or None."
                ) from None
            counts.append(round(ratio) if abs(ratio) < 2**31 else None)
        return tuple(counts)

    def _ago(self, source: int, ticks: int) -> int | None:
        ring = self._rings[source]
        return ring[(self._tick - ticks) % len(ring)]

    def _slide(self, name: str, newest: int | None, source: int, ticks: int, limit: int) -> int:
        """Return the sum of a window or its number of values; the sum updates both."""
        window = self._windows[source, ticks, limit]
        if name == "values":
            return window[1]
        oldest = self._ago(source, ticks) if ticks else None
        if oldest is not None:
            window[0] -= oldest
            window[1] -= 1
        if newest is not None and window[1] < limit:
            window[0] += newest
            window[1] += 1
        return window[0]


def _car_counts(
    manifest: Manifest, program: Program, car: Mapping[str, Any]
) -> dict[str, tuple[int | None, ...]]:
    """Return the counts of a car's facts and numbers; None: unknown."""
    names = {fact.name for fact in program.facts} | {n.name for n in program.numbers}
    if unused := sorted({*car} - names):
        raise InputError(
            f"{manifest.name} does not use {', '.join(unused)} of a car. It uses: "
            f"{', '.join(sorted(names)) or 'no properties'}."
        )
    numbers = []
    for number in program.numbers:
        value = car.get(number.name)
        try:
            exact = None if value is None else Fraction(value)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{value!r} is not a number. Give a number.") from None
        numbers.append(None if exact is None else round_number(exact, Fraction(number.grain)))
    facts = [fact.count(car.get(fact.name)) for fact in program.facts]
    return {"fact": tuple(facts), "number": tuple(numbers)}


def compile_program(catalog: Catalog, manifest: Manifest) -> Program:
    """Return the program of a published version.

    Raises what `write_program` raises, and `QuestionError` or `DataError` for definitions that
    contradict each other.
    """
    # The kernel compiles the same definitions, and raises for those that it cannot compute.
    _ = Predictor.from_manifest(catalog.signals, manifest).plan.program
    return write_program(catalog, manifest)


# Checks are ticks of synthetic drives, with the angle at each. An export contains no logged data.
# The kernel of the warehouse, which does not use programs, computes the angles again.

SMOOTH_TICKS = 300
HOSTILE_TICKS = 200


@dataclass(frozen=True)
class TestVector:
    """A synthetic drive, and the angle at each tick."""

    name: str
    car: Mapping[str, object]
    """Facts of the car, as in logs."""
    facts: tuple[int | None, ...]
    """Facts as whole numbers, in the order of the program; None: unknown."""
    numbers: tuple[int | None, ...]
    """Numbers in counts, in the order of the program; None: unknown."""
    samples: tuple[Sample, ...]
    """Counts at each tick."""
    angles: tuple[int | None, ...]
    """Counts of the program's angle at each tick; None: no angle."""
    states: tuple[tuple[int, ...], ...] = ()
    """Values of the steps `state` after each tick, if there are any."""


def make_checks(catalog: Catalog, manifest: Manifest, program: Program) -> tuple[TestVector, ...]:
    """Return a smooth drive and adversarial ones, with the angle at every tick.

    Raises `RefusedError` if the estimator and the kernel of the warehouse differ.
    """
    facts = {a.name: 2**16 if a.equals is None else a.equals for a in program.facts}
    ends = ((number, (-1) ** (i + 1) * COUNT_MAX) for i, number in enumerate(program.numbers))
    hostile = facts | {number.name: count * number.grain for number, count in ends}
    unaware, extreme = (Estimator(catalog, manifest, car) for car in ({}, hostile))
    drives = {
        "smooth": (unaware, {}, _smooth(program)),
        "extremes": (extreme, facts, _extremes(program, np.random.default_rng(1))),
        "holes": (unaware, {}, _holes(program, np.random.default_rng(2))),
        "standstill": (extreme, facts, _standstill(program, np.random.default_rng(3))),
    }
    checks = []
    for name, (estimator, car, samples) in drives.items():
        estimator.restart()
        ticks, angles, states = tuple(samples), list[int | None](), []
        for sample in ticks:
            angles.append(program.angle.count(estimator.advance(sample)))
            states.append(estimator.states)
        check = TestVector(
            name,
            car,
            *(estimator.car["fact"], estimator.car["number"]),
            ticks,
            tuple(angles),
            tuple(states) if program.states else (),
        )
        _compare_with_kernel(catalog.signals, manifest, program, check)
        checks.append(check)
    return tuple(checks)


def _compare_with_kernel(
    signals: SignalCatalog, manifest: Manifest, program: Program, check: TestVector
) -> None:
    """Raise `RefusedError` if the kernel computes other angles than those of the test vector."""
    counts = zip(program.numbers, check.numbers, strict=True)
    numbers = {number.name: count for number, count in counts if count is not None}
    expected = angles_by_kernel(signals, manifest, program, check.car, numbers, check.samples)
    for tick, (angle, kernel_angle) in enumerate(zip(check.angles, expected, strict=True)):
        if angle != kernel_angle:
            raise RefusedError(
                f"{manifest.name} cannot be exported: at tick {tick} of the check {check.name!r}, "
                f"its program computes the angle {angle}, and the kernel of the warehouse "
                f"{kernel_angle}. Keep the version, and report this fault of fleet-slip."
            )


def angles_by_kernel(
    signals: SignalCatalog,
    manifest: Manifest,
    program: Program,
    facts: Mapping[str, object],
    numbers: Mapping[str, int],
    samples: Sequence[Sample],
) -> list[int | None]:
    """Compute the angle of each tick from the columns of the kernel, in exact integers."""
    predictor = Predictor.from_manifest(signals, manifest)
    drive = drive_counts(program, predictor, facts, numbers, samples)
    return angles_of_columns(program, compute_columns(predictor.plan, drive))


def drive_counts(
    program: Program,
    predictor: Predictor,
    facts: Mapping[str, object],
    numbers: Mapping[str, int],
    samples: Sequence[Sample],
) -> DriveCounts:
    """Convert samples of consecutive ticks to a drive of the warehouse."""
    valid = zip(*(valid_counts(sample, program.signals) for sample in samples), strict=True)
    counts = {
        signal.name: pa.array(values, pa.int16())
        for signal, values in zip(program.signals, valid, strict=True)
    }
    rows = pa.table({"tick": np.arange(len(samples), dtype=np.int64), **counts})
    used = {name: facts.get(name) for name in predictor.plan.facts}
    return counts_of(rows, predictor.plan, used, numbers)


def angles_of_columns(program: Program, columns: FloatArray) -> list[int | None]:
    """Compute the angle of each row from the columns of the terms, shape (terms, rows)."""
    angle = program.angle
    missing: BoolArray = np.any(np.isnan(columns), axis=0)
    counts = np.where(missing, 0.0, columns).astype(np.int64).astype(object)
    total = np.full(columns.shape[1], angle.intercept + (1 << (angle.bits - 1)), dtype=object)
    for (_, coefficient), column in zip(angle.terms, counts, strict=True):
        total += coefficient * column
    rounded = [max(-angle.limit, min(angle.limit, int(value >> angle.bits))) for value in total]
    return [None if lacks else value for value, lacks in zip(rounded, missing, strict=True)]


def valid_counts(sample: Sample, signals: Sequence[Input]) -> Sample:
    """Replace counts outside the valid range by None."""
    return tuple(
        count if count is not None and signal.min_count <= count <= signal.max_count else None
        for count, signal in zip(sample, signals, strict=True)
    )


def _smooth(program: Program) -> Iterable[Sample]:
    """Yield a drive without missing counts: every signal oscillates with its own period."""
    ticks = np.arange(SMOOTH_TICKS)
    waves = []
    for i, signal in enumerate(program.signals):  # triangles of an eighth of the range
        low, high, period = signal.min_count, signal.max_count, 60 + 14 * i
        height, middle = (high - low) // 8, (low + high) // (4 if low >= 0 else 2)
        distance = abs(2 * (ticks % period) - period)
        waves.append((middle + height * distance // period - height // 2).tolist())
    yield from zip(*waves, strict=True)


def _extremes(program: Program, random: np.random.Generator) -> Iterable[Sample]:
    """Yield the ends of the ranges, together and separately, and counts just beyond them."""
    for tick in range(HOSTILE_TICKS):
        if tick % 40 < 10:
            high = tick % 80 < 40
            yield tuple(s.max_count if high else s.min_count for s in program.signals)
        else:
            yield tuple(_extreme(signal, random) for signal in program.signals)


def _extreme(signal: Input, random: np.random.Generator) -> int | None:
    low, high = signal.min_count, signal.max_count
    counts: Sample = (low, high, -1, 0, 1, high // 2)
    if random.random() >= 0.98:
        counts = (low - 1, high + 1, None)
    return counts[random.integers(len(counts))]


def _holes(program: Program, random: np.random.Generator) -> Iterable[Sample]:
    """Yield a drive with gaps, long and short, and missing single values."""
    gap = 0
    for _ in range(HOSTILE_TICKS):
        starts = random.random() < 0.05
        gap = gap - 1 if gap else (1, 2, 30)[random.integers(3)] if starts else 0
        yield tuple(
            None
            if gap or random.random() < 0.01
            else int(random.integers(0, signal.max_count // 4 + 1))
            for signal in program.signals
        )


def _standstill(program: Program, random: np.random.Generator) -> Iterable[Sample]:
    """Yield a start from standstill: features that divide by speed have no value at first."""
    for tick in range(HOSTILE_TICKS):
        yield tuple(
            int(random.integers(-2, 3)) + signal.max_count * tick // (8 * HOSTILE_TICKS)
            for signal in program.signals
        )


def checks_csv(program: Program, checks: Sequence[TestVector]) -> str:
    """Return a CSV file with a row for each tick: the columns of the SQL statement, and the angle.

    An empty cell is a missing value, or no angle.
    """
    facts = tuple(dict.fromkeys(fact.name for fact in program.facts))
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [signal.column for signal in program.signals]
    numbers = [number.name for number in program.numbers]
    writer.writerow(["drive_id", "tick", *columns, *facts, *numbers, "expected_angle"])
    signal_scales = [signal.scale for signal in program.signals]
    number_scales = [number.grain for number in program.numbers]
    for check in checks:
        car = [*(check.car.get(name) for name in facts), *_physical(check.numbers, number_scales)]
        for tick, (sample, angle) in enumerate(zip(check.samples, check.angles, strict=True)):
            values = _physical(sample, signal_scales)
            writer.writerow([check.name, tick, *values, *car, angle])
    return text.getvalue()


def _physical(counts: Sequence[int | None], scales: Sequence[Decimal]) -> list[str | None]:
    return [
        None if count is None else f"{count * scale:f}"
        for count, scale in zip(counts, scales, strict=True)
    ]
