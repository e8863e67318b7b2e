"""From the counts of one drive to the integer columns of a feature set, sample by sample.

This is the one path to the columns of models with windows: Gram rows, scores, evaluations and
predictions all come through it. It computes what the SQL of `fleet_slip.catalogue.column_sql` says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.arithmetic import Arithmetic, parse
from fleet_slip.catalogue.columns import Definition, features_behind, limit_of
from fleet_slip.catalogue.features import FeatureCatalogue
from fleet_slip.catalogue.signals import COUNT_MAX, catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.lookback import quotients, quotients_of_whole, scaled

BLOCK_ROWS = 2**12
"""Rows that are worked on at once, so that they stay in the processor's cache."""

_EXACT = 2**53


@dataclass(frozen=True)
class DriveCounts:
    """One drive in the order of time.

    Attributes:
        ticks: rising, shape (rows,).
        counts: of each signal, shape (rows,); any number where it is missing.
        present: where a signal is not missing, shape (rows,); a signal that never is has none.
        facts: what the car knows of itself, by drive column.
    """

    ticks: NDArray[Any]
    counts: Mapping[str, NDArray[Any]]
    present: Mapping[str, BoolArray] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether no tick between the first and the last is missing."""
        return bool(int(self.ticks[-1]) - int(self.ticks[0]) + 1 == len(self.ticks))


@dataclass(frozen=True)
class RowColumn:
    """A column of one row: a logged signal, or a feature with its arithmetic and largest count."""

    name: str
    arithmetic: Arithmetic | None = None
    limit: int = COUNT_MAX

    @property
    def inputs(self) -> tuple[str, ...]:
        """The signals that it is computed from."""
        return self.arithmetic.inputs if self.arithmetic else (self.name,)


@dataclass(frozen=True)
class ColumnPlan:
    """What to compute of a drive.

    Attributes:
        names: the columns, in order.
        rows: the columns of one row that are asked for, looked back on, or tell a row's part.
        windows: the columns over time.
    """

    names: tuple[str, ...]
    rows: Mapping[str, RowColumn]
    windows: Mapping[str, Definition]

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        features: Mapping[str, RowColumn],
        windows: Mapping[str, Definition],
        also: Sequence[str] = (),
    ) -> "ColumnPlan":
        """Plan columns by name: of `features`, of `windows`, or else logged signals.

        `also` are columns of one row that are computed beside them. Raises `DataError` if two of
        them define the same feature differently.
        """
        rows: dict[str, RowColumn] = {}
        for name in (*names, *also):
            if name not in windows:
                rows[name] = features.get(name, RowColumn(name))
        features_behind(windows)
        for one in windows.values():
            row = RowColumn(one.of)
            if one.sql:
                row = RowColumn(one.of, parse(one.sql), limit_of(one.of_bits))
            if rows.setdefault(one.of, row) != row:
                raise DataError(f"the feature {one.of} is defined in two ways.")
        return cls(tuple(names), rows, dict(windows))

    @classmethod
    def of_set(cls, known: FeatureCatalogue, name: str) -> "ColumnPlan":
        """Plan the columns of a feature set, the label last."""
        one = known.feature_set(name)
        divided_by = [known.regimes[regime].of for regime in one.regimes]
        features = {
            f: RowColumn(f, parse(known.features[f].sql), known.features[f].limit)
            for f in (*one.features, *divided_by)
            if f in known.features
        }
        return cls.of(one.columns, features, known.definitions(name), divided_by)

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals that are needed, in catalogue order."""
        used = {name for row in self.rows.values() for name in row.inputs}
        return tuple(name for name in catalogue().signals if name in used)

    @property
    def facts(self) -> tuple[str, ...]:
        """The drive columns that are needed."""
        return tuple(dict.fromkeys(w.fact.name for w in self.windows.values() if w.fact))

    @property
    def limits(self) -> tuple[int, ...]:
        """The largest size that each column can have."""
        return tuple(
            limit_of(self.windows[name].bits)
            if name in self.windows
            else self.rows[name].limit + (self.rows[name].arithmetic is None)
            for name in self.names
        )


class DriveColumns:
    """The columns of one drive; `fill` gives those of some of its rows."""

    def __init__(self, plan: ColumnPlan, drive: DriveCounts) -> None:
        """Compute the columns of single rows, and their running sums. Raises `DataError`."""
        if (np.diff(drive.ticks) <= 0).any():
            raise DataError(
                "the ticks of a drive do not rise: it cannot be looked back on. Run: fleet-slip "
                "verify"
            )
        self.plan, self.drive = plan, drive
        self.rows = len(drive.ticks)
        self.clipped = np.zeros(self.rows)
        self._values = self._row_values()
        self._whole = drive.whole
        self._sums: dict[str, FloatArray] = {}
        self._counts: dict[str, FloatArray] = {}
        self._begin: dict[int, NDArray[np.int64]] = {}
        for one in plan.windows.values():
            self._prepare(one)

    def fill(self, first: int, out: FloatArray) -> None:
        """Write the columns of the rows from `first`, shape (columns, block); missing is NaN."""
        last = first + out.shape[1]
        for name, row in zip(self.plan.names, out, strict=True):
            if name in self.plan.windows:
                self._look_back(self.plan.windows[name], first, row)
            else:
                row[:] = self._values[name][first:last]

    @property
    def rows_now(self) -> Mapping[str, FloatArray]:
        """The columns of single rows, shape (rows,) each; missing is NaN."""
        return self._values

    def compute(self) -> FloatArray:
        """Return all columns, shape (columns, rows); missing is NaN."""
        out = np.empty((len(self.plan.names), self.rows))
        self.fill(0, out)
        return out

    def _row_values(self) -> dict[str, FloatArray]:
        """Return the columns of single rows, NaN where missing."""
        found = {name: np.empty(self.rows) for name in self.plan.rows}
        for first in range(0, self.rows, BLOCK_ROWS):
            part = slice(first, min(first + BLOCK_ROWS, self.rows))
            known: dict[Any, Any] = {}
            for name, row in self.plan.rows.items():
                found[name][part] = self._block_of_row(row, part, known)
        return found

    def _block_of_row(self, row: RowColumn, part: slice, known: dict[Any, Any]) -> FloatArray:
        drive = self.drive
        there: list[BoolArray] = [drive.present[n][part] for n in row.inputs if n in drive.present]
        if row.arithmetic is None:
            values = drive.counts[row.name][part].astype(np.float64)
        else:
            inputs = {n: self._input(n, part, row.arithmetic.dtype, known) for n in row.inputs}
            counts, chosen = row.arithmetic(inputs, known)
            if chosen is not None:
                there.append(chosen)
            values = np.clip(counts, -row.limit, row.limit).astype(np.float64, copy=False)
            if row.arithmetic.bound > row.limit and (outside := counts != values).any():
                self.clipped[part] += np.logical_and.reduce([outside, *there])
        if there:
            missing = ~np.logical_and.reduce(there)
            if missing.any():
                values[missing] = np.nan
        return values

    def _input(self, name: str, part: slice, kind: type, known: dict[Any, Any]) -> NDArray[Any]:
        """Return a signal's counts of some rows, zero where missing."""
        if (name, kind) not in known:
            counts: NDArray[Any] = self.drive.counts[name][part].astype(kind)
            if name in self.drive.present:
                counts[~self.drive.present[name][part]] = 0
            known[name, kind] = counts
        found: NDArray[Any] = known[name, kind]
        return found

    def _prepare(self, one: Definition) -> None:
        if one.over is None or one.over == "lag":
            return
        if 2 * (self.rows + 1) * limit_of(one.of_bits) * one.ratio.numerator >= _EXACT:
            raise DataError(f"the drive has {self.rows:,} rows: too many to look back on.")
        values = self._values[one.of]
        if one.of not in self._sums:
            missing = np.isnan(values)
            self._sums[one.of] = _before(np.where(missing, 0.0, values))
            if missing.any() or not self._whole:
                self._counts[one.of] = _before((~missing).astype(np.float64))
        if one.of in self._counts and one.ticks not in self._begin:
            self._begin[one.ticks] = self._begins(one.ticks)

    def _begins(self, ticks: int) -> NDArray[np.int64]:
        """Return the first row of the window of each row; 0 ticks are all since the start."""
        if not ticks:
            return np.zeros(self.rows, dtype=np.int64)
        now = self.drive.ticks.astype(np.int64)
        return np.searchsorted(now, now - ticks, side="right").astype(np.int64)

    def _look_back(self, one: Definition, first: int, out: FloatArray) -> None:
        clipped = self.clipped[first : first + len(out)]
        numerator, denominator = float(one.ratio.numerator), float(one.ratio.denominator)
        limit = float(limit_of(one.bits))
        if one.over is None:
            values = self._values[one.of][first : first + len(out)]
            scaled(values, numerator, denominator, limit, out, clipped)
        elif one.over == "lag":
            values = self._ago(self._values[one.of], one.ticks, first, len(out))
            scaled(values, numerator, denominator, limit, out, clipped)
        else:
            fixed, each = (denominator, 0.0) if one.over == "sum" else (0.0, denominator)
            terms = (numerator, fixed, each, limit, out, clipped)
            sums, counts = self._sums[one.of], self._counts.get(one.of)
            if counts is None:
                quotients_of_whole(sums, first, one.ticks or self.rows + 1, *terms)
            else:
                quotients(sums, counts, self._begin[one.ticks], first, *terms)
        if one.fact:
            number = one.fact.number(self.drive.facts[one.fact.name])
            product = out * (np.nan if number is None else float(number))
            ratio = one.fact.ratio
            scaled(product, float(ratio.numerator), float(ratio.denominator), limit, out, clipped)

    def _ago(self, values: FloatArray, ticks: int, first: int, rows: int) -> FloatArray:
        """Return the values so many ticks before each of some rows; NaN where there is none."""
        now = self.drive.ticks[first : first + rows].astype(np.int64)
        if self._whole:
            at = np.arange(first, first + rows) - ticks
            there = at >= 0
        else:
            every = self.drive.ticks.astype(np.int64)
            at = np.searchsorted(every, now - ticks)
            there = every[at] == now - ticks
        return np.where(there, values[np.where(there, at, 0)], np.nan)


def _before(values: FloatArray) -> FloatArray:
    """Return the sum of the values before each row and of all, shape (rows + 1,)."""
    sums = np.empty(len(values) + 1)
    sums[0] = 0.0
    np.cumsum(values, out=sums[1:])
    return sums
