"""Brings the time bases of a log into one table, in which every signal keeps its own samples.

A row is a sample time of one of them, and has no value of the others. The table comes in windows of
time, so that only some rows of each base are in memory.
"""

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np
import polars as pl

from fleet_slip.ingest.formats.log_source import BASE, Base

DISORDER = "\0disorder"
"""Column that says what is wrong with a row's time among those of its base, null if nothing."""
HELD = "\0held "
"""Before the name of a column: its last value at the time, whatever base the row is of."""
ROW = "\0row"
"""Column with the row's number, from 1: those of the first base come first, then the next."""
_RIGHT = "\0right"
"""Column with the last right time of the base up to each row: where the row stands among others."""
WINDOW_ROWS = 2**16
"""A window has about this many rows of all bases together."""


def merge_bases(
    bases: Sequence[Base], time: str, held: Sequence[str], split_gap_s: float
) -> Iterator[pl.DataFrame]:
    """Yield the rows of all bases, window by window in the order of time, with `BASE` as a number.

    Times are in s. Within a base they must increase: what does not has its reason in `DISORDER`,
    because once bases are mixed it could not be told, and its place is where the base's last right
    time was. The `held` columns say of every row what was last known at its place, for
    `split_gap_s` at most: conditions and names of drives hold for all signals. Rows of one time are
    in one window. Where only one base has rows, they come as they are.
    """
    opened = [_Opened(base) for base in bases]
    columns = {name: kind for one in opened for name, kind in one.columns.items()}
    some = [one for one in opened if one.has_rows]
    if len(some) == 1:
        yield from (_completed(batch, columns) for batch in some[0].batches)
        return
    coming, offset = [], 0
    for number, one in enumerate(some):
        judged = _Clock(time, split_gap_s, offset).judge_all(one.batches)
        coming.append(_Coming(number, judged, max(WINDOW_ROWS // len(some), 1)))
        if number + 1 < len(some):
            offset += one.base.count_rows()
    columns |= {BASE: pl.Int32(), DISORDER: pl.String(), ROW: pl.Int64(), _RIGHT: pl.Float64()}
    of = {name: number for number, one in reversed([*enumerate(some)]) for name in one.columns}
    lasting = [_Lasting(name, of.get(name, -1), time, split_gap_s) for name in held]
    while coming := [one for one in coming if one.fill()]:
        until = min(one.reached for one in coming)
        rows = pl.concat([_completed(one.take(until), columns) for one in coming])
        rows = rows.sort(_RIGHT, maintain_order=True)
        yield rows.with_columns(one.hold(rows) for one in lasting).drop(_RIGHT)


class _Opened:
    """A base of which the first rows were read, so that its columns are known."""

    def __init__(self, base: Base) -> None:
        self.base, batches = base, base.read()
        first = next(batches)
        while not first.height and (following := next(batches, None)) is not None:
            first = following
        self.columns, self.has_rows = dict(first.schema), first.height > 0
        self.batches = chain([first], batches)


def _completed(rows: pl.DataFrame, columns: dict[str, pl.DataType]) -> pl.DataFrame:
    """Return rows with all columns, null where they have none."""
    absent = [pl.lit(None, kind).alias(name) for name, kind in columns.items() if name not in rows]
    return rows.with_columns(absent).select(*columns)


class _Clock:
    """Judges the times of one base, row by row: what is wrong with each."""

    def __init__(self, time: str, split_gap_s: float, offset: int) -> None:
        self._time, self._gap_s, self._rows = time, split_gap_s, offset
        self._before_s, self._right_s = np.nan, -np.inf

    def judge_all(self, batches: Iterator[pl.DataFrame]) -> Iterator[pl.DataFrame]:
        """Yield the rows with `DISORDER`, `ROW` and `_RIGHT`; the last one waits for the next."""
        waiting: pl.DataFrame | None = None
        for batch in batches:
            rows = batch if waiting is None else pl.concat([waiting, batch])
            if rows.height > 1:
                yield self._judge(rows.head(rows.height - 1), rows[self._time][-1])
            waiting = rows.tail(1)
        if waiting is not None and waiting.height:
            yield self._judge(waiting, None)

    def _judge(self, rows: pl.DataFrame, after_s: float | None) -> pl.DataFrame:
        """Judge rows before a time. One far ahead is `isolated`, or all after it would be late."""
        time_s = rows[self._time].to_numpy()
        before_s = np.concatenate([[self._before_s], time_s[:-1]])
        after_s = np.nan if after_s is None else after_s
        next_s = np.concatenate([time_s[1:], [after_s]])
        with np.errstate(invalid="ignore"):
            ahead = (time_s - before_s > self._gap_s) & (next_s < time_s)
        usable = np.where(ahead | ~np.isfinite(time_s), -np.inf, time_s)
        right_s = np.maximum.accumulate(np.concatenate([[self._right_s], usable]))
        late, twice = time_s < right_s[:-1], time_s == right_s[:-1]
        reasons: pl.Series | pl.Expr = pl.lit(None, pl.String)
        if (late | twice | ahead).any():
            names = np.select(
                [ahead, late, twice], ["isolated", "time_backwards", "time_duplicate"], ""
            )
            reasons = pl.Series(names.tolist()).replace("", None)
        self._before_s, self._right_s = time_s[-1], right_s[-1]
        self._rows += rows.height
        return rows.with_columns(
            reasons.alias(DISORDER),
            pl.int_range(self._rows - rows.height + 1, self._rows + 1, dtype=pl.Int64).alias(ROW),
            pl.Series(_RIGHT, right_s[1:]),
        )


def _resized(batches: Iterator[pl.DataFrame], most: int) -> Iterator[pl.DataFrame]:
    """Yield the rows of batches with `most` at once: of large ones less, of small ones together."""
    small: list[pl.DataFrame] = []
    for batch in batches:
        small.append(batch)
        if sum(one.height for one in small) >= most:
            yield from pl.concat(small).iter_slices(most)
            small = []
    if small:
        yield from pl.concat(small).iter_slices(most)


class _Coming:
    """Rows of a base that were read and are in no window yet."""

    def __init__(self, number: int, batches: Iterator[pl.DataFrame], most: int) -> None:
        self._number = pl.lit(number, pl.Int32).alias(BASE)
        self._slices = _resized(batches, most)
        self._rows = pl.DataFrame()

    def fill(self) -> bool:
        """Read on if no rows wait; return whether some do now."""
        if not self._rows.height:
            self._rows = next(self._slices, self._rows)
        return self._rows.height > 0

    @property
    def reached(self) -> float:
        """Place of the last row."""
        return float(self._rows[_RIGHT][-1])

    def take(self, until: float) -> pl.DataFrame:
        """Return what waits up to a time."""
        number = int(self._rows[_RIGHT].search_sorted(until, side="right"))
        taken, self._rows = self._rows.head(number), self._rows.slice(number)
        return taken.with_columns(self._number)


class _Lasting:
    """A column of one base that says something of the rows of all."""

    def __init__(self, name: str, base: int, time: str, longest_s: float) -> None:
        self._name, self._longest_s = name, longest_s
        self._says = (
            pl.col(name).is_not_null()
            & (pl.col(BASE) == base)
            & pl.col(DISORDER).is_null()
            & pl.col(time).is_finite()
        )
        self._last: list[pl.DataFrame] = []

    def hold(self, rows: pl.DataFrame) -> pl.Series:
        """Return the last value at the place of each row of a window, null if it is too old."""
        said = rows.filter(self._says).select(_RIGHT, self._name)
        known = pl.concat([*self._last, said])
        self._last = [known.tail(1)]
        if not known.height:
            return pl.Series(HELD + self._name, [None] * rows.height, known[self._name].dtype)
        time_s, at_s = known[_RIGHT].to_numpy(), rows[_RIGHT].to_numpy()
        last = np.searchsorted(time_s, at_s, side="right") - 1
        lasts = (last >= 0) & (at_s - time_s[np.maximum(last, 0)] <= self._longest_s)
        held = known[self._name].gather(np.maximum(last, 0)).set(pl.Series(~lasts), None)
        return held.alias(HELD + self._name)
