"""Reads the rows of a log in bounded batches.

A batch is a Polars frame with the columns that a mapping uses: text (CSV, text in Parquet), 64-bit
floats, dates or timestamps. CSV fields stay text, so that the quarantine can store other texts than
numbers as they were written.
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
            yield from metered(_with_later_hours(plain, log, mapping))
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
        metered_bases = [metered(base) for base in bases]
        for rows in merge_bases(metered_bases, OWN_TIME, held, split_gap_s, signals, log):
            yield from rows.iter_slices(BATCH_ROWS)


def read_columns(log: Path, mapping: Mapping, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
    """Yield columns of a log with one time base, in bounded batches. Raises `InputError`."""
    with file_errors(log), open_log(log, mapping.formats) as source:
        yield from Budget.for_file(log).metered(source.batches(columns))


def _with_times(
    batches: Iterator[pl.DataFrame], log: Path, column: str, mapping: Mapping
) -> Iterator[pl.DataFrame]:
    """Yield the rows that have a time, with their times in s. Raises `InputError`.

    Other texts than times are NaN. Rows without a time belong to other, longer columns.
    """
    for batch in batches:
        times_s = seconds_of(batch[column], mapping.time, mapping.formats, log)
        yield batch.with_columns(times_s.alias(OWN_TIME)).drop_nulls(OWN_TIME)


LATER = "\0later"
"""Column that is true in the second of two equal hours, when clocks are set back."""
_SET_BACK_S = (1200.0, 7500.0)
"""Steps back in time, in s, by which clocks are set."""


def _with_later_hours(
    batches: Iterator[pl.DataFrame], log: Path, mapping: Mapping
) -> Iterator[pl.DataFrame]:
    """Yield rows with `LATER`, if the mapping states the zone of its timestamps."""
    time, column = mapping.time, mapping.time.column
    if time.zone is None or column is None or time.date is not None:
        yield from batches
        return
    local_time, before_s, is_later = time.model_copy(update={"zone": None}), np.nan, False
    for batch in batches:
        local_s = seconds_of(batch[column], local_time, mapping.formats, log).to_numpy()
        steps_s = np.diff(local_s, prepend=before_s)
        # A step back by about an hour begins the later hour, any other jump ends it.
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
"""Column with the fault of a row's time within its base, null if the time is valid."""
HELD = "\0held "
"""Prefix of a column's name: the column's last value before the row's time, from any base."""
ROW = "\0row"
"""Column with the row's number among those of its base, from 1."""
_LATEST = "\0latest"
"""Column with the latest valid time of the base up to each row, by which rows are sorted."""
WINDOW_ROWS = 2**16
"""Approximate number of rows of a window, of all bases together."""


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
    `DISORDER`, and is sorted at the latest valid time of the base. Every row gets the last value of
    the `held` columns (conditions, names of drives), unless that is older than `split_gap_s`. Rows
    of a base without columns of `signals` are dropped. The rows of a single base are yielded
    unchanged. With `log`, bases without a common time raise `InputError`.
    """
    opened = [_TimeBase(base, time, split_gap_s) for base in bases]
    columns = {name: kind for base in opened for name, kind in base.columns.items()}
    filled = [base for base in opened if base.has_rows]
    no_rows = pl.DataFrame(schema=columns)
    if len(filled) == 1:
        absent = columns.keys() - filled[0].columns.keys()
        nulls = [pl.lit(None, columns[name]).alias(name) for name in absent]
        yield from (rows.with_columns(nulls) for rows in filled[0].batches)
        return
    starts_s = [base.start_s for base in filled]
    if log is not None and starts_s and min(starts_s) < EARLIEST_S <= max(starts_s):
        raise _no_common_time(filled, log)
    base_of = {name: n for n, base in reversed([*enumerate(filled)]) for name in base.columns}
    with_signals = [n for n, base in enumerate(filled) if base.columns.keys() & set(signals)]
    number_of_rows = max(WINDOW_ROWS // max(len(filled), 1), 1)
    streams = [base.checked_rows(number, number_of_rows) for number, base in enumerate(filled)]
    waiting = [no_rows] * len(streams)
    last: dict[str, pl.DataFrame] = {}
    while True:
        waiting = [
            rows if rows.height else next(stream, no_rows)
            for rows, stream in zip(waiting, streams, strict=True)
        ]
        if not any(rows.height for rows in waiting):
            break
        # Up to this time the rows of every base are in memory.
        until_s = min(rows[_LATEST][-1] for rows in waiting if rows.height)
        counts = [
            rows[_LATEST].search_sorted(until_s, side="right") if rows.height else 0
            for rows in waiting
        ]
        pairs = list(zip(waiting, counts, strict=True))
        window = pl.concat([no_rows, *(rows.head(n) for rows, n in pairs)], how="diagonal")
        waiting = [rows.slice(n) for rows, n in pairs]
        window = window.sort(_LATEST, maintain_order=True)
        for name in held:
            is_valid = pl.col(DISORDER).is_null() & pl.col(time).is_finite()
            is_of_base = pl.col(BASE) == base_of.get(name, -1)
            stated = window.filter(is_valid & is_of_base & pl.col(name).is_not_null())
            values = stated.select(_LATEST, pl.col(name).alias(HELD + name))
            # The last value of the window before comes first.
            values = pl.concat([last.get(name, values.clear()), values]).set_sorted(_LATEST)
            last[name] = values.tail(1)
            window = window.join_asof(values, on=_LATEST, tolerance=split_gap_s)
        yield window.drop(_LATEST).filter(pl.col(BASE).is_in(with_signals))
    if log is not None:
        _require_common_time([filled[number] for number in with_signals], log)


_MAX_APART_S = 60.0
"""Longest time in s between the end of a time base and the start of another in one recording."""


def _require_common_time(bases: Sequence["_TimeBase"], log: Path) -> None:
    """Raise `InputError` if a base has no time in common with any other: its clock differs."""
    for base in bases:
        distances_s = [
            max(other.start_s - base.end_s, base.start_s - other.end_s)
            for other in bases
            if other is not base
        ]
        if distances_s and min(distances_s) > _MAX_APART_S:
            raise _no_common_time(bases, log)


def _no_common_time(bases: Sequence["_TimeBase"], log: Path) -> InputError:
    """Return the error of time bases of different clocks."""
    starts = ", ".join(f"{base.example!r} begins at {base.start_s:,.2f} s" for base in bases[:4])
    return InputError(
        f"{quote_name(log)}: its signals have no time in common: {starts}. Are their clocks "
        "different? Record them with one clock, or map the signals of one of them."
    )


class _TimeBase:
    """The rows of a time base. The first batch defines the columns."""

    def __init__(self, batches: Iterator[pl.DataFrame], time: str, split_gap_s: float) -> None:
        self._time, self._gap_s = time, split_gap_s
        first = next(batches)
        while not first.height and (following := next(batches, None)) is not None:
            first = following
        self.columns, self.has_rows = dict(first.schema), first.height > 0
        times_s = first[time].to_numpy() if self.has_rows else np.zeros(0)
        self.start_s = float(next(iter(times_s[np.isfinite(times_s)]), np.nan))
        self.end_s = -np.inf
        """The latest valid time so far."""
        self.example = next((name for name in first.columns if name != time), "")
        self.batches = chain([first], batches)

    def checked_rows(self, number: int, count: int) -> Iterator[pl.DataFrame]:
        """Yield at most `count` rows at once, with `BASE`, `ROW`, `DISORDER` and `_LATEST`.

        A row far ahead of both neighbours is `isolated`; otherwise all rows after it would be late.
        Therefore the last row of a batch waits for the next batch.
        """
        row, before_s = 0, np.nan
        waiting = pl.DataFrame(schema=self.columns)
        slices = (piece for batch in self.batches for piece in batch.iter_slices(count))
        for piece in chain(slices, [None]):
            rows = waiting if piece is None else pl.concat([waiting, piece])
            ready, waiting = (rows, rows) if piece is None else (rows.head(-1), rows.tail(1))
            if not ready.height:
                continue
            next_s = np.append(rows[self._time].to_numpy(), np.nan)[1 : ready.height + 1]
            time_s = ready[self._time].to_numpy()
            with np.errstate(invalid="ignore"):
                step_s = np.diff(time_s, prepend=before_s)
            ahead = (step_s > self._gap_s) & (next_s < time_s)
            usable = np.where(ahead | ~np.isfinite(time_s), -np.inf, time_s)
            latest_s = np.maximum.accumulate(np.append(self.end_s, usable))
            disorder = (
                pl.when(pl.Series(ahead))
                .then(pl.lit("isolated"))
                .when(pl.Series(time_s < latest_s[:-1]))
                .then(pl.lit("time_backwards"))
                .when(pl.Series(time_s == latest_s[:-1]))
                .then(pl.lit("time_duplicate"))
            )
            yield ready.with_columns(
                disorder.alias(DISORDER),
                pl.lit(number, pl.Int32).alias(BASE),
                pl.int_range(row + 1, row + ready.height + 1, dtype=pl.Int64).alias(ROW),
                pl.Series(_LATEST, latest_s[1:]),
            )
            row, before_s, self.end_s = row + ready.height, time_s[-1], latest_s[-1]
