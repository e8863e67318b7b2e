"""Reads the rows of a log in bounded batches.

A batch is a Polars frame with the columns that a mapping uses: text (CSV, text in Parquet), 64-bit
floats, dates or timestamps. CSV fields stay text, so that what is not a number can be quarantined
as it was written.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import polars as pl

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.reading import file_errors
from fleet_slip.ingest.formats.source import BASE, EARLIEST_S, OWN_TIME, Budget
from fleet_slip.ingest.formats.tables import BATCH_ROWS
from fleet_slip.ingest.log_files import open_log, seconds_of
from fleet_slip.ingest.mapping import Mapping

_CLOCK = "this file has its own clock: set own_clock = true under [time]"
_NO_CLOCK = "this file has no clock: set column or rate_hz under [time]"


def read_batches(log: Path, mapping: Mapping) -> Iterator[pl.DataFrame]:
    """Yield the columns of a log that a mapping uses, in its order, in bounded batches.

    Several time bases are merged by `merge_bases`. Raises `InputError` if the file cannot be read,
    if only one of file and mapping has a clock, or if a column is missing or ambiguous.
    """
    columns_by_time = mapping.time_bases()
    with file_errors(log), open_log(log, mapping.formats, mapping.member_times) as source:
        if source.has_clock != mapping.time.own_clock:
            raise InputError(
                f"{quote_name(log)}: {_CLOCK if source.has_clock else _NO_CLOCK}, in the mapping "
                f"{mapping.name!r}."
            )
        metered = Budget.for_file(log).metered
        if len(columns_by_time) == 1 and not source.has_clock:
            plain = source.batches(next(iter(columns_by_time.values())))
            yield from metered(_with_later_hours(plain, mapping))
            return
        if source.has_clock:
            bases = [base for columns in columns_by_time.values() for base in source.bases(columns)]
        else:
            bases = [
                _with_times(source.batches(columns), log, str(time_column), mapping)
                for time_column, columns in columns_by_time.items()
            ]
        held, split_gap_s = mapping.common_columns(), mapping.time.split_gap_s
        signals = {signal.column for signal in mapping.signals.values()}
        for rows in merge_bases(
            [*map(metered, bases)], OWN_TIME, held, split_gap_s, signals, log=log
        ):
            yield from rows.iter_slices(BATCH_ROWS)


def read_columns(log: Path, mapping: Mapping, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
    """Yield columns of a log with one time base, in bounded batches. Raises `InputError`."""
    with file_errors(log), open_log(log, mapping.formats) as source:
        yield from Budget.for_file(log).metered(source.batches(columns))


def _with_times(
    batches: Iterator[pl.DataFrame], log: Path, column: str, mapping: Mapping
) -> Iterator[pl.DataFrame]:
    """Yield the rows that have a time, with their times in s. Raises `InputError`.

    A text that is no time is NaN. Rows without a time are those of other, longer columns.
    """
    for batch in batches:
        try:
            times_s = seconds_of(batch[column], mapping.time, mapping.formats).alias(OWN_TIME)
        except ValueError as error:
            raise InputError(f"{quote_name(log)}: {error}") from None
        rows = batch.with_columns(times_s)
        yield rows.filter(pl.col(OWN_TIME).is_not_null())


LATER = "\0later"
"""Column that is true in the second of two equal hours, when clocks are set back."""
_SET_BACK_S = (1200.0, 7500.0)
"""Steps back in time, in s, by which clocks are set."""


def _with_later_hours(batches: Iterator[pl.DataFrame], mapping: Mapping) -> Iterator[pl.DataFrame]:
    """Yield rows with `LATER`, where the mapping names the zone of its timestamps."""
    time, column = mapping.time, mapping.time.column
    if time.zone is None or column is None or time.date is not None:
        yield from batches
        return
    local, before_s, is_later = time.model_copy(update={"zone": None}), np.nan, False
    for batch in batches:
        local_s = seconds_of(batch[column], local, mapping.formats).to_numpy()
        steps_s = np.diff(local_s, prepend=before_s)
        back = (steps_s <= -_SET_BACK_S[0]) & (steps_s >= -_SET_BACK_S[1])
        turns = np.where(back, 1, np.where(np.abs(steps_s) >= _SET_BACK_S[0], -1, 0))
        last = np.maximum.accumulate(np.where(turns != 0, np.arange(turns.size), -1))
        later = np.where(last >= 0, turns[last] > 0, is_later)
        if later.size:
            before_s, is_later = local_s[-1], bool(later[-1])
        yield batch.with_columns(pl.Series(LATER, later, dtype=pl.Boolean))


# Several time bases become one table: a row is a sample of one base, and null in the columns of the
# others. The table is made in windows of time, so that few rows of each base are in memory.

DISORDER = "\0disorder"
"""Column with the fault of a row's time within its base, null if it is right."""
HELD = "\0held "
"""Prefix of a column's name: its last value at the row's time, of any base."""
ROW = "\0row"
"""Column with the row's number among those of its base, from 1."""
_RIGHT = "\0right"
"""Column with the last right time of the base up to each row, by which rows are sorted."""
WINDOW_ROWS = 2**16
"""A window has about this many rows of all bases together."""


def merge_bases(
    bases: Sequence[Iterator[pl.DataFrame]],
    time: str,
    held: Sequence[str],
    split_gap_s: float,
    signals: Collection[str],
    log: Path | None = None,
) -> Iterator[pl.DataFrame]:
    """Yield the rows of all bases, window by window in the order of time, with `BASE` as a number.

    Times are in s. A row whose time does not increase within its base has the reason in
    `DISORDER`, and is sorted at the base's last right time. Every row gets the last value of the
    `held` columns (conditions, names of drives), unless that is older than `split_gap_s`. A base
    without columns of `signals` has no rows of its own. The rows of a single base are yielded
    unchanged. With `log`, bases without a common time raise `InputError`.
    """
    opened = [_PendingBase(base, time, split_gap_s) for base in bases]
    columns = {name: kind for base in opened for name, kind in base.columns.items()}
    filled = [base for base in opened if base.has_rows]
    if len(filled) == 1:
        yield from (_completed(batch, columns) for batch in filled[0].batches)
        return
    pending = filled
    starts_s = [base.start_s for base in filled]
    if log is not None and starts_s and min(starts_s) < EARLIEST_S <= max(starts_s):
        raise _no_common_time(filled, log)
    for number, base in enumerate(filled):
        base.begin(number, max(WINDOW_ROWS // len(filled), 1))
    columns |= {BASE: pl.Int32(), DISORDER: pl.String(), ROW: pl.Int64(), _RIGHT: pl.Float64()}
    base_of_column = {
        name: number for number, base in reversed([*enumerate(filled)]) for name in base.columns
    }
    held_columns = [
        _HeldColumn(name, base_of_column.get(name, -1), time, split_gap_s) for name in held
    ]
    with_signals = [
        n for n, base in enumerate(filled) if not base.columns.keys().isdisjoint(signals)
    ]
    while pending := [base for base in pending if base.fill()]:
        until = min(base.reached for base in pending)
        rows = pl.concat([_completed(base.take(until), columns) for base in pending])
        rows = rows.sort(_RIGHT, maintain_order=True)
        rows = rows.with_columns(column.hold(rows) for column in held_columns).drop(_RIGHT)
        yield rows.filter(pl.col(BASE).is_in(with_signals))
    if log is not None:
        _require_common_time([filled[number] for number in with_signals], log)


_MAX_APART_S = 60.0
"""Longest time in s between the end of a time base and the start of another in one recording."""


def _require_common_time(bases: Sequence["_PendingBase"], log: Path) -> None:
    """Raise `InputError` if a base shares no time with another one: it has another clock."""
    for base in bases:
        distances_s = [
            max(other.start_s - base.end_s, base.start_s - other.end_s)
            for other in bases
            if other is not base
        ]
        if distances_s and min(distances_s) > _MAX_APART_S:
            raise _no_common_time(bases, log)


def _no_common_time(bases: Sequence["_PendingBase"], log: Path) -> InputError:
    """Return the error of time bases of different clocks."""
    starts = ", ".join(f"{base.example!r} begins at {base.start_s:,.2f} s" for base in bases[:4])
    return InputError(
        f"{quote_name(log)}: its signals have no time in common: {starts}. Are their clocks "
        "different? Record them with one clock, or map the signals of one of them."
    )


def _completed(rows: pl.DataFrame, columns: dict[str, pl.DataType]) -> pl.DataFrame:
    """Return rows with all columns, null where they have none."""
    absent = [pl.lit(None, kind).alias(name) for name, kind in columns.items() if name not in rows]
    return rows.with_columns(absent).select(*columns)


class _PendingBase:
    """The rows of a base that are in no window yet. Its first batch gives the columns."""

    def __init__(self, batches: Iterator[pl.DataFrame], time: str, split_gap_s: float) -> None:
        self._time, self._gap_s = time, split_gap_s
        first = next(batches)
        while not first.height and (following := next(batches, None)) is not None:
            first = following
        self.columns, self.has_rows = dict(first.schema), first.height > 0
        times_s = first[time].to_numpy() if self.has_rows else np.zeros(0)
        self.start_s = float(next(iter(times_s[np.isfinite(times_s)]), np.nan))
        self.example = next((name for name in first.columns if name != time), "")
        self.batches = chain([first], batches)
        self._before_s, self._right_s, self._judged_rows = np.nan, -np.inf, 0
        self._rows = pl.DataFrame()

    def begin(self, number: int, count: int) -> None:
        """Set the base's number, and how many rows to read at once."""
        self._number = pl.lit(number, pl.Int32).alias(BASE)
        self._slices = _resized(self._judged(), count)

    def _judged(self) -> Iterator[pl.DataFrame]:
        """Yield rows with `DISORDER`, `ROW` and `_RIGHT`. The last one waits for the next batch."""
        waiting: pl.DataFrame | None = None
        for batch in self.batches:
            rows = batch if waiting is None else pl.concat([waiting, batch])
            if rows.height > 1:
                yield self._judge(rows.head(rows.height - 1), rows[self._time][-1])
            waiting = rows.tail(1)
        if waiting is not None and waiting.height:
            yield self._judge(waiting, None)

    def _judge(self, rows: pl.DataFrame, after_s: float | None) -> pl.DataFrame:
        """Check times. A row far ahead is `isolated`, or all rows after it would be late."""
        time_s = rows[self._time].to_numpy()
        before_s = np.concatenate([[self._before_s], time_s[:-1]])
        next_s = np.append(time_s[1:], np.nan if after_s is None else after_s)
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
        first, self._judged_rows = self._judged_rows + 1, self._judged_rows + rows.height
        return rows.with_columns(
            reasons.alias(DISORDER),
            pl.int_range(first, self._judged_rows + 1, dtype=pl.Int64).alias(ROW),
            pl.Series(_RIGHT, right_s[1:]),
        )

    def fill(self) -> bool:
        """Read the next rows if none wait. Returns True if some wait now."""
        if not self._rows.height:
            self._rows = next(self._slices, self._rows)
        return self._rows.height > 0

    @property
    def end_s(self) -> float:
        """The last right time so far."""
        return float(self._right_s)

    @property
    def reached(self) -> float:
        """The time of the last row that waits."""
        return float(self._rows[_RIGHT][-1])

    def take(self, until: float) -> pl.DataFrame:
        """Return the waiting rows up to a time."""
        number = int(self._rows[_RIGHT].search_sorted(until, side="right"))
        taken, self._rows = self._rows.head(number), self._rows.slice(number)
        return taken.with_columns(self._number)


def _resized(batches: Iterator[pl.DataFrame], count: int) -> Iterator[pl.DataFrame]:
    """Yield the rows of batches in frames of `count` rows; joins small batches, splits large."""
    small: list[pl.DataFrame] = []
    for batch in batches:
        small.append(batch)
        if sum(batch.height for batch in small) >= count:
            yield from pl.concat(small).iter_slices(count)
            small = []
    if small:
        yield from pl.concat(small).iter_slices(count)


class _HeldColumn:
    """A column of one base whose last value applies to the rows of all bases."""

    def __init__(self, name: str, base: int, time: str, longest_s: float) -> None:
        self._name, self._longest_s = name, longest_s
        self._is_stated = (
            pl.col(name).is_not_null()
            & (pl.col(BASE) == base)
            & pl.col(DISORDER).is_null()
            & pl.col(time).is_finite()
        )
        self._last: list[pl.DataFrame] = []

    def hold(self, rows: pl.DataFrame) -> pl.Series:
        """Return the last value at the time of each row, null if it is too old."""
        stated = rows.filter(self._is_stated).select(
            _RIGHT, pl.col(self._name).alias(HELD + self._name)
        )
        values = pl.concat([*self._last, stated]).set_sorted(_RIGHT)
        self._last = [values.tail(1)]
        held = rows.select(_RIGHT).join_asof(values, on=_RIGHT, tolerance=self._longest_s)
        return held[HELD + self._name]
