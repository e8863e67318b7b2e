"""Computes the integer columns of a feature set from the counts of one drive, block by block.

Gram rows, scores, evaluations and predictions come through it, and it computes what the SQL of
`fleet_slip.columns.column_sql` says. A step of the lowering is one operation of NumPy on a block of
rows, in binary64 with NaN where it is missing. Steps that may exceed 53 bits are in int64.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial, reduce
from math import inf, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import COURSE, YAW_RATE
from fleet_slip.catalog.definitions import Definition, Slope, limit_of, plain_column, rows_behind
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.columns.column_sql import CountedColumns, rows_of
from fleet_slip.columns.lowering import (
    OPERATIONS,
    POWERS,
    largest_in,
    most_products,
    size_of,
)
from fleet_slip.columns.recursion import Recursion, run_recursion
from fleet_slip.errors import DataError, QuestionError

BLOCK_ROWS = 2**13
"""Rows of a block: few enough that its columns stay in the processor's cache."""

_EXACT = 2**53
_COUNTS = np.iinfo(np.int16)


@dataclass(frozen=True)
class DriveCounts:
    """The counts of one drive.

    Attributes
    ----------
    ticks
        Increasing, shape (rows,).
    counts, present
        By signal, shape (rows,); a signal without missing values has no `present`.
    facts
        Vehicle attributes, by drive column.
    numbers
        Counts of the known calibration parameters.
    """

    ticks: NDArray[Any]
    counts: Mapping[str, NDArray[Any]]
    present: Mapping[str, BoolArray] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    numbers: Mapping[str, int] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """True if no tick between the first and the last is missing."""
        return bool(int(self.ticks[-1]) - int(self.ticks[0]) + 1 == len(self.ticks))

    def segment(
        self, rows: Any, facts: Mapping[str, Any], numbers: Mapping[str, int]
    ) -> "DriveCounts":
        """Return some rows, with these attributes and parameters."""
        counts = {name: values[rows] for name, values in self.counts.items()}
        present = {name: values[rows] for name, values in self.present.items()}
        return DriveCounts(self.ticks[rows], counts, present, facts, numbers)


def as_counts(
    signals: SignalCatalog,
    values: Mapping[str, FloatArray],
    names: Sequence[str],
    facts: Mapping[str, Any],
) -> DriveCounts:
    """Return the counts of some signals of a drive that has a row for every tick.

    The values are by SI column, shape (ticks,), NaN where null.
    """
    counts, present = {}, {}
    for name in names:
        column = values[signals[name].column]
        present[name] = np.isfinite(column)
        scaled = np.where(present[name], column, 0.0) / float(signals[name].scale)
        counts[name] = np.rint(scaled).astype(np.int64)
    ticks = np.arange(len(next(iter(counts.values()))))
    return DriveCounts(ticks, counts, present, facts)


# The columns to compute of a drive.


@dataclass(frozen=True)
class ColumnPlan:
    """Columns to compute of a drive: by `names`, of `rows` (one row each) and `windows`.

    `rows` has what is looked back on, too.
    """

    names: tuple[str, ...]
    rows: Mapping[str, Definition]
    windows: Mapping[str, Definition]

    @classmethod
    def from_definitions(
        cls,
        names: Sequence[str],
        features: Mapping[str, Definition],
        windows: Mapping[str, Definition],
    ) -> "ColumnPlan":
        """Plan columns by name: of `features`, of `windows`, or logged.

        Raises `DataError` for a feature that is defined in two ways.
        """
        single = [name for name in names if name not in windows]
        rows = {name: features.get(name, plain_column(name)) for name in single}
        return cls(tuple(names), rows_of(rows, windows), dict(windows))

    @classmethod
    def of_set(cls, catalog: Catalog, name: str, fold: str | None = None) -> "ColumnPlan":
        """Plan the columns of a feature set, the label last; of changes, what makes it.

        For the `fold` see `Catalog.definitions`.
        """
        feature_set = catalog.feature_set(name)
        features = catalog.rows(feature_set.features)
        inputs = (*feature_set.signals, *feature_set.features, *feature_set.windows)
        changes = (*inputs, COURSE, YAW_RATE)
        columns = changes if feature_set.change_ticks else feature_set.columns
        return cls.from_definitions(columns, features, catalog.definitions(name, fold))

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals that are needed, sorted."""
        return tuple(sorted({name for row in self.rows.values() for name in row.signals}))

    @property
    def facts(self) -> tuple[str, ...]:
        """The drive columns that are needed."""
        return tuple(dict.fromkeys(fact.name for fact in self.program.counted.lowered.facts))

    @property
    def numbers(self) -> tuple[str, ...]:
        """Calibration parameters of the car that the columns need."""
        return tuple(number.name for number in self.program.counted.lowered.numbers)

    @property
    def limits(self) -> tuple[int, ...]:
        """The largest size that each column can have."""
        return tuple(
            limit_of(self.windows[name].bits)
            if name in self.windows
            else limit_of(self.rows[name].of_bits) + (not self.rows[name].sql)
            for name in self.names
        )

    @cached_property
    def most_rows(self) -> float:
        """Number of rows up to which the slopes are exact, here and on board."""
        composites = (row.made for row in rows_behind(self.windows).values())
        slopes = [
            len(composite.equations) for composite in composites if isinstance(composite, Slope)
        ]
        return min(map(most_products, slopes), default=inf)

    @cached_property
    def program(self) -> "ColumnProgram":
        """The program that computes the columns, one for equal plans. Raises `QuestionError`."""
        return _program(tuple(self.rows.items()), tuple(self.windows.items()))

    def blocks(self, drive: DriveCounts) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield blocks of a drive: row range, values, and number of clipped values per row.

        Values have the shape (columns, rows), NaN where missing. Raises `DataError` for a drive
        with invalid ticks or too many rows.
        """
        _require_exact(self, drive)
        places = [self.program.counted.places[name] for name in self.names]
        evaluation = _Evaluation(self.program, drive)
        for first in range(0, len(drive.ticks), BLOCK_ROWS):
            rows = slice(first, min(first + BLOCK_ROWS, len(drive.ticks)))
            values, clipped = evaluation.block(rows)
            columns = np.empty((len(places), rows.stop - first))
            for column, place in enumerate(places):
                columns[column] = _narrow(values[place])
            yield rows, columns, clipped


def compute_columns(plan: ColumnPlan, drive: DriveCounts) -> FloatArray:
    """Return all columns of a drive, (columns, rows), NaN where missing; raises as `blocks`."""
    columns = np.empty((len(plan.names), len(drive.ticks)))
    for rows, block, _ in plan.blocks(drive):
        columns[:, rows] = block
    return columns


def _require_exact(plan: ColumnPlan, drive: DriveCounts) -> None:
    """Raise `DataError` for a drive whose sums may not be exact."""
    rows, most_rows = len(drive.ticks), plan.most_rows
    if (drive.ticks[1:] <= drive.ticks[:-1]).any():
        raise DataError(
            "the ticks of a drive do not increase: it has no windows. Run: fleet-slip verify"
        )
    for window in plan.windows.values():
        if window.over not in {None, "lag"}:
            per_row = 2 * limit_of(window.of_bits) * window.ratio.numerator
            most_rows = min(most_rows, (_EXACT - 1) // per_row - 1)
    if rows > most_rows:
        raise DataError(f"the drive has {rows:,} rows: too many for windows.")
    for name in plan.signals:
        counts = drive.counts[name]
        if counts.dtype == np.int16 or not rows:
            continue
        if not _COUNTS.min <= counts.min() <= counts.max() <= _COUNTS.max:
            raise DataError(f"{name} has counts beyond 16 bits.")


# Evaluation of the steps.


@dataclass(frozen=True)
class ColumnProgram:
    """The steps of a plan, in the order of their evaluation.

    Attributes
    ----------
    counted
        The steps, and the columns among them.
    recursion
        The steps that are run row by row.
    before, after
        Numbers of the other steps: those that do not depend on the recursion, and those that do.
    wide
        Steps on integers that may exceed 53 bits.
    unused_after
        By number of a step, the steps that no later step reads.
    """

    counted: CountedColumns
    recursion: Recursion
    before: tuple[int, ...]
    after: tuple[int, ...]
    wide: frozenset[int]
    unused_after: Mapping[int, list[int]]


@lru_cache(maxsize=64)
def _program(
    rows: tuple[tuple[str, Definition], ...], windows: tuple[tuple[str, Definition], ...]
) -> ColumnProgram:
    """Lower columns and order their steps.

    Raises `QuestionError` for a division by a number below 1.
    """
    counted = CountedColumns.from_definitions(dict(rows), dict(windows))
    steps, ranges = counted.steps, counted.ranges
    wide, of_sums = set[int](), set[int]()
    for number, step in enumerate(steps):
        operands = step.operands
        if step.name in _DIVISIONS and ranges[operands[1]][1] <= 0:
            raise QuestionError("a feature divides by a number that is not positive.")
        if OPERATIONS[step.name].over_time:
            of_sums.add(number)  # a drive with so many rows is refused
        elif step.name in _ARITHMETIC:
            if not of_sums.isdisjoint(operands):
                of_sums.add(number)
            elif largest_in(step, number, ranges) >= _EXACT:
                wide.add(number)
    recursion = Recursion.of_steps(steps)
    outside = [number for number in range(len(steps)) if number not in recursion.members]
    before = tuple(number for number in outside if number not in recursion.dependent)
    after = tuple(number for number in outside if number in recursion.dependent)
    last_reader = {i: number for number in (*before, *after) for i in steps[number].operands}
    unused_after: dict[int, list[int]] = {}
    for number in last_reader.keys() - {*counted.places.values(), *recursion.inputs}:
        unused_after.setdefault(last_reader[number], []).append(number)
    return ColumnProgram(counted, recursion, before, after, frozenset(wide), unused_after)


@dataclass(frozen=True)
class Wide:
    """Integers of 64 bits, with any value where `presence` is NaN."""

    values: Any
    presence: Any


Vector = Any
"""Values of a step in the rows of a block: binary64, a number for all rows, or `Wide`."""


def _widen(vector: Vector) -> Wide:
    if isinstance(vector, Wide):
        return vector
    if np.asarray(vector).dtype.kind != "f":
        return Wide(np.int64(vector), 0.0)
    return Wide(np.where(np.isnan(vector), 0.0, vector).astype(np.int64), vector)


def _narrow(vector: Vector) -> Any:
    if not isinstance(vector, Wide):
        return vector
    return np.where(np.isnan(vector.presence), nan, vector.values)


def _signed(size: Any, sign_of: Any) -> Any:
    return np.where(sign_of < 0, -size, size)


def _nearest(a: Any, b: Any) -> Any:
    """Return a / b to the nearest integer, halves away from zero."""
    size = np.asarray(np.abs(a) + 0.5 * b)  # exact below 2^52
    size /= b
    np.floor(size, out=size)
    return np.copysign(size, a, out=size)


def _power(a: Any, b: Any) -> Any:
    """Return the least power of two p with a <= b p."""
    power = 1.0 + 0.0 * a  # NaN stays
    for _ in range(POWERS):
        power = np.where(a > b * power, 2.0 * power, power)
    return power


_DIVISIONS = ("//", "nearest")
_ARITHMETIC = ("+", "-", "*", "//", "nearest", "negative", "abs", "sign")

_VECTORS: Mapping[str, Callable[..., Any]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "//": lambda a, b: np.trunc(a / b),
    "nearest": _nearest,
    "negative": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "min": np.minimum,
    "max": np.maximum,
    "power": _power,
    "shift": lambda a, bits: _nearest(a, 1 << bits),
    "at_least": lambda a, b: np.where(a >= b, a, nan),
    "where": lambda a, b: np.where(np.isnan(b), nan, a),
    "else": lambda a, b: np.where(np.isnan(a), b, a),
}
"""Operations on the values of a row in binary64, which pass NaN on."""

_INTEGERS: Mapping[str, Callable[..., Any]] = {
    **{name: _VECTORS[name] for name in ("+", "-", "*", "negative", "abs", "sign")},
    "//": lambda a, b: _signed(np.abs(a) // b, a),
    "nearest": lambda a, b: _signed((2 * np.abs(a) + b) // (2 * b), a),
}
"""Types of int64 columns."""


class _RunningSum:
    """Sums and numbers of a step's values up to each row; both begin with 0 before the first row.

    Sums are integers below 2^53. `gapless`: no value is missing so far.
    """

    def __init__(self, rows: int) -> None:
        self.sums, self.counts = np.zeros(rows + 1), np.zeros(rows + 1)
        self.rows, self.gapless = 0, True

    def add(self, values: FloatArray) -> None:
        before, self.rows = self.rows, self.rows + len(values)
        sums, counts = (totals[before + 1 : self.rows + 1] for totals in (self.sums, self.counts))
        np.cumsum(values, out=sums)
        if np.isnan(sums[-1]):
            missing = np.isnan(values)
            self.gapless = False
            np.cumsum(np.where(missing, 0.0, values), out=sums)
            np.cumsum(~missing, out=counts)
        else:
            counts[:] = np.arange(1, len(values) + 1)
        sums += self.sums[before]
        counts += self.counts[before]


class _Evaluation:
    """The evaluation of a program over the blocks of a drive, in their order."""

    def __init__(self, program: ColumnProgram, drive: DriveCounts) -> None:
        self._program, self._drive, self._counted = program, drive, program.counted
        self._ticks = drive.ticks.astype(np.int64)
        self._is_complete = drive.is_complete
        lowered = program.counted.lowered
        self._signals = list(lowered.signals)
        facts = [fact.count(drive.facts[fact.name]) for fact in lowered.facts]
        numbers = [drive.numbers.get(number.name) for number in lowered.numbers]
        self.facts, self.numbers = (
            [nan if count is None else float(count) for count in counts]
            for counts in (facts, numbers)
        )
        self._words = program.recursion.memory()
        self._running: dict[int, _RunningSum] = {}
        self._history: dict[int, FloatArray] = {}
        self._begins: dict[int, IntArray] = {}

    def block(self, rows: slice) -> tuple[dict[int, Vector], FloatArray]:
        """Return the values of the columns' steps, and the number of clipped values per row."""
        self._rows, self._values = rows, dict[int, Vector]()
        self._clipped = np.zeros(rows.stop - rows.start)
        with np.errstate(all="ignore"):  # of missing values
            self._evaluate(self._program.before)
            if self._program.recursion.members:
                self._recur()
            self._evaluate(self._program.after)
        return self._values, self._clipped

    def _evaluate(self, numbers: Sequence[int]) -> None:
        for number in numbers:
            self._values[number] = self._value(number)
            for unused in self._program.unused_after.get(number, ()):
                del self._values[unused]

    def _value(self, number: int) -> Vector:
        step = self._counted.steps[number]
        name = step.name
        if name in _READERS:
            return _READERS[name](self, *step.operands, *step.plain)
        if name == "clip":
            return self._clip(number, *step.operands)
        operands = [self._values[i] for i in step.operands]
        is_wide = any(isinstance(operand, Wide) for operand in operands)
        if number in self._program.wide or (is_wide and name in (*_INTEGERS, "at_least", "where")):
            return self._wide(number, name, [_widen(operand) for operand in operands])
        operands = [_narrow(operand) for operand in operands]
        if name in _DIVISIONS and self._counted.ranges[step.operands[1]][0] <= 0:
            operands[1] = np.where(operands[1] > 0, operands[1], nan)
        return _VECTORS[name](*operands, *step.plain)

    def _wide(self, number: int, name: str, operands: list[Wide]) -> Vector:
        values = [operand.values for operand in operands]
        presence = reduce(np.add, [operand.presence for operand in operands])
        if name == "at_least":
            presence = np.where(values[0] >= values[1], presence, nan)
        if name in ("at_least", "where"):
            return Wide(values[0], presence)
        if name in _DIVISIONS:
            presence = np.where(values[1] > 0, presence, nan)
            values[1] = np.maximum(values[1], 1)
        result = Wide(_INTEGERS[name](*values), presence)
        return result if size_of(self._counted.ranges[number]) >= _EXACT else _narrow(result)

    def _signal(self, place: int) -> FloatArray:
        name = self._signals[place]
        counts = self._drive.counts[name][self._rows].astype(np.float64)
        if name in self._drive.present:
            counts[~self._drive.present[name][self._rows]] = nan
        return counts

    def _clip(self, number: int, source: int, limit_step: int) -> Vector:
        """Clip to a constant limit, and count clipped values."""
        value, limit = _narrow(self._values[source]), self._counted.ranges[limit_step][1]
        if size_of(self._counted.ranges[source]) <= limit:
            return value
        outside = np.abs(value) > limit
        if not np.any(outside):
            return value
        self._clipped += self._counted.times.get(number, 0) * outside
        return np.clip(value, -limit, limit)

    def _all_rows(self, source: int) -> FloatArray:
        return np.broadcast_to(_narrow(self._values[source]), self._clipped.shape)

    def _window(self, source: int, ticks: int, _: int, name: str) -> Vector:
        """Return the sum or number of the values of a window; of 0 ticks, since the start."""
        first, stop = self._rows.start, self._rows.stop
        if source not in self._running:
            self._running[source] = _RunningSum(len(self._ticks))
        running = self._running[source]
        if running.rows < stop:
            running.add(self._all_rows(source))
        totals = running.sums if name == "sum" else running.counts
        until = totals[first + 1 : stop + 1]
        if not ticks:
            return until
        if not self._is_complete or first + 1 < ticks:
            return until - totals[self._find_begins(ticks)[self._rows]]
        if name == "values" and running.gapless:
            return float(ticks)
        return until - totals[first + 1 - ticks : stop + 1 - ticks]

    def _ago(self, source: int, ticks: int) -> FloatArray:
        if source not in self._history:
            self._history[source] = np.empty(len(self._ticks))
        history = self._history[source]
        history[self._rows] = self._all_rows(source)
        past = self._find_begins(ticks + 1)[self._rows]
        is_logged = self._ticks[past] == self._ticks[self._rows] - ticks
        return np.where(is_logged, history[past], nan)

    def _find_begins(self, ticks: int) -> IntArray:
        """Return the first row within so many ticks up to each row."""
        if ticks not in self._begins:
            self._begins[ticks] = (
                np.maximum(np.arange(len(self._ticks)) + 1 - ticks, 0)
                if self._is_complete
                else np.searchsorted(self._ticks, self._ticks - ticks, side="right")
            )
        return self._begins[ticks]

    def _recur(self) -> None:
        """Run the recursive steps row by row, and store those that others read."""
        recursion = self._program.recursion
        inputs = np.array([self._all_rows(source) for source in recursion.inputs])
        results = np.empty((len(recursion.outputs), inputs.shape[1]))
        places = np.array([recursion.places[i] for i in recursion.outputs], dtype=np.int64)
        run_recursion(recursion.code, self._words, places, inputs, results)
        self._values |= zip(recursion.outputs, results, strict=True)


_READERS: Mapping[str, Callable[..., Vector]] = {
    "constant": lambda _, value: value,
    "signal": _Evaluation._signal,
    "fact": lambda evaluation, place: evaluation.facts[place],
    "number": lambda evaluation, place: evaluation.numbers[place],
    "ago": _Evaluation._ago,
    "sum": partial(_Evaluation._window, name="sum"),
    "values": partial(_Evaluation._window, name="values"),
}
"""Steps that read inputs or past values."""
