"""Cuts checked rows into drives: uninterrupted segments, each in memory until it ends."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import polars as pl

from fleet_slip.arrays import BoolArray
from fleet_slip.ingest.checked_columns import describe_rejected
from fleet_slip.ingest.columns import STEP_S, TIME_EPSILON_S
from fleet_slip.ingest.formats.source import Spool

MAX_DRIVE_S = 2**19 * STEP_S
"""A longer drive is cut after this time, some 87 minutes, so that it fits into memory."""
MAX_DRIVE_ROWS = 2**19
"""Rows of a time base in one drive: logs faster than 100 Hz have shorter drives."""


@dataclass(frozen=True)
class DriveSamples:
    """The rows of one drive by time base, in chunks that are not copied together.

    With several bases, each has only the signals with values in it.
    """

    group: int
    bases: dict[int, pl.DataFrame]

    @cached_property
    def height(self) -> int:
        """Number of rows."""
        return sum(rows.height for rows in self.bases.values())

    @cached_property
    def start_s(self) -> float:
        """The first time."""
        return min(float(rows["time"][0]) for rows in self.bases.values())

    @cached_property
    def end_s(self) -> float:
        """The last time."""
        return max(float(rows["time"][-1]) for rows in self.bases.values())

    @cached_property
    def intervals_s(self) -> dict[int, float]:
        """The median time between two rows of each base; one tick for a single row."""
        steps_s = {base: np.diff(rows["time"].to_numpy()) for base, rows in self.bases.items()}
        return {
            b: float(np.median(steps)) if steps.size else STEP_S for b, steps in steps_s.items()
        }

    @property
    def frame(self) -> pl.DataFrame:
        """All rows in one frame."""
        return pl.concat(self.bases.values(), how="diagonal")

    def interval_of(self, signal: str) -> float:
        """Return the usual time between the samples of a signal's time base."""
        bases = (base for base, rows in self.bases.items() if signal in rows.columns)
        return self.intervals_s.get(next(bases, -1), STEP_S)

    def column(self, name: str) -> pl.Series:
        """Return a column of the only base."""
        (rows,) = self.bases.values()
        return rows[name] if name in rows.columns else pl.repeat(np.nan, rows.height, eager=True)

    def samples(self, name: str) -> pl.DataFrame:
        """Return `time` and a signal where it has a value, by time."""
        frames = [rows.select("time", name) for rows in self.bases.values() if name in rows.columns]
        empty = pl.DataFrame(schema={"time": pl.Float64, name: pl.Float64})
        samples = pl.concat([empty, *frames]).drop_nulls(name)
        return samples if samples["time"].is_sorted() else samples.sort("time", maintain_order=True)


class DriveCutter:
    """Cuts the rows of one group after another, such as cars, and rejects rows out of order.

    A step in time larger than `split_gap_s`, forward or back, begins a drive. A row that far from
    both neighbours is `isolated`, so that one wrong time stamp does not cut a drive. Rows that are
    not later than all rows of the drive are `time_duplicate` or `time_backwards`. The result does
    not depend on the blocks: a row whose next row is in another block waits for it.
    """

    def __init__(self, split_gap_s: float, reject: Callable[[pl.DataFrame], None]) -> None:
        """Set the gap that ends a drive, and a function that takes rejected rows."""
        self._gap_s, self._reject = split_gap_s + TIME_EPSILON_S, reject
        self._begin_group(-1)

    def _begin_group(self, group: int) -> None:
        self._group = group
        self._waiting: pl.DataFrame | None = None
        self._pieces: dict[int, list[pl.DataFrame]] = defaultdict(list)
        """Rows of the open drive by time base."""
        self._rows_by_base: dict[int, int] = defaultdict(int)
        self._start_s = np.nan
        """Time of the first row of the open drive."""
        self._latest_s = np.nan
        """Latest time of a row since the last step in time."""
        self._last_s = self._last_placed_s = np.nan
        """Times of the last row, and of the last row that is not isolated."""

    def cut(self, rows: pl.DataFrame) -> Iterator[DriveSamples]:
        """Yield the drives that end in a block, in which the rows of each group are together."""
        if rows.is_empty():
            return
        is_one_group = rows["group"][0] == rows["group"][-1]
        groups = [rows] if is_one_group else rows.partition_by("group", maintain_order=True)
        for of_group in groups:
            if of_group["group"][0] != self._group:
                yield from self.end_group()
                self._begin_group(of_group["group"][0])
            yield from self._continue_group(of_group)

    def end_group(self) -> Iterator[DriveSamples]:
        """Yield the open drive, after the last row of a group."""
        if self._waiting is not None:
            self._reject(describe_rejected(self._waiting, "isolated"))
        yield from self._end_drive()

    def _continue_group(self, rows: pl.DataFrame) -> Iterator[DriveSamples]:
        if self._waiting is not None:
            rows, self._waiting = pl.concat([self._waiting, rows]), None
        time_s = rows["time"].to_numpy()
        is_far = self._is_far(time_s, self._last_s)
        is_isolated = is_far & np.append(is_far[1:], True)
        if is_isolated[-1]:  # the next row decides
            rows, self._waiting = rows.head(-1), rows.tail(1)
            is_isolated, time_s = is_isolated[:-1], time_s[:-1]
        if rows.is_empty():
            return
        self._last_s = time_s[-1]
        rows = self._reject_rows(rows, is_isolated, "isolated")
        time_s = rows["time"].to_numpy()
        if not time_s.size:
            return
        is_far = self._is_far(time_s, self._last_placed_s)
        self._last_placed_s = time_s[-1]
        starts = np.flatnonzero(is_far)
        for start, end in pairwise(np.unique([0, *starts, time_s.size])):
            if is_far[start]:
                yield from self._end_drive()
                self._latest_s = np.nan
            yield from self._continue_drive(rows.slice(start, end - start))

    def _is_far(self, time_s: np.ndarray, before_s: float) -> BoolArray:
        """Return a mask of rows far from the row before; without a row before it is True."""
        is_far: BoolArray = ~(np.abs(np.diff(time_s, prepend=before_s)) <= self._gap_s)
        return is_far

    def _reject_rows(self, rows: pl.DataFrame, is_rejected: BoolArray, reason: str) -> pl.DataFrame:
        """Reject the rows of a mask; return the remaining rows."""
        if not is_rejected.any():
            return rows
        mask = pl.Series(is_rejected)
        self._reject(describe_rejected(rows.filter(mask), reason))
        return rows.filter(~mask)

    def _continue_drive(self, rows: pl.DataFrame) -> Iterator[DriveSamples]:
        """Add rows that follow without a gap. Yields drives that would last too long."""
        if "base" not in rows.columns:  # the times of several bases are checked base by base
            time_s = rows["time"].to_numpy()
            latest_s = np.fmax.accumulate(np.append(self._latest_s, time_s))
            self._latest_s = latest_s[-1]
            is_backwards, is_twice = time_s < latest_s[:-1], time_s == latest_s[:-1]
            rows = self._reject_rows(rows, is_backwards, "time_backwards")
            rows = self._reject_rows(rows, is_twice[~is_backwards], "time_duplicate")
        while rows.height:
            if not self._pieces:
                self._start_s = rows["time"][0]
            number = self._count_fitting(rows)
            if number:
                self._add(rows.head(number))
            rows = rows.slice(number)
            if rows.height:
                yield from self._end_drive()

    def _count_fitting(self, rows: pl.DataFrame) -> int:
        """Return the number of rows that fit into the open drive; a new drive fits at least one."""
        time_s = rows["time"].to_numpy()
        fitting = int(np.searchsorted(time_s, self._start_s + MAX_DRIVE_S))
        fitting = fitting if self._pieces else max(fitting, 1)
        if "base" not in rows.columns:
            return min(fitting, MAX_DRIVE_ROWS - self._rows_by_base[0])
        number = rows.select(pl.int_range(pl.len()).over("base")).to_series()
        before = rows["base"].replace_strict(self._rows_by_base, default=0, return_dtype=pl.Int64)
        beyond = (number + before >= MAX_DRIVE_ROWS).arg_true()
        return int(beyond[0]) if len(beyond) and beyond[0] < fitting else fitting

    def _add(self, rows: pl.DataFrame) -> None:
        """Add rows to the open drive, by time base and without the columns that are empty there."""
        several = "base" in rows.columns
        pieces = rows.partition_by("base", as_dict=True) if several else {(0,): rows}
        for (base,), piece in pieces.items():
            empty = [column.name for column in piece if column.null_count() == piece.height]
            self._pieces[base].append(piece.drop(empty) if empty else piece)
            self._rows_by_base[base] += piece.height

    def _end_drive(self) -> Iterator[DriveSamples]:
        if self._pieces:
            pieces = sorted(self._pieces.items())
            bases = {base: pl.concat(frames, how="diagonal") for base, frames in pieces}
            yield DriveSamples(self._group, bases)
        self._pieces, self._rows_by_base = defaultdict(list), defaultdict(int)


# The rows of drives that alternate, such as those of several cars, are sorted first.

MAX_VALUES_IN_MEMORY = 2**22
"""Maximum number of values in memory, 32 MiB; other rows are in a temporary file."""
BLOCK_BYTES = 2**23
"""Number of bytes of a group to read at once."""


def sort_by_group(blocks: Iterable[pl.DataFrame]) -> Iterator[pl.DataFrame]:
    """Yield all rows by group, those of a group in their order. Raises `InputError`."""
    in_memory: list[pl.DataFrame] = []
    spool, groups, values = Spool(), set[int](), 0
    for block in blocks:
        in_memory.append(block)
        values += block.height * block.width
        if values > MAX_VALUES_IN_MEMORY:
            groups |= _spill(pl.concat(in_memory), spool)
            in_memory, values = [block.clear()], 0
    rows = pl.concat(in_memory)
    if not groups:
        yield rows.sort("group", maintain_order=True)
        return
    for group in sorted(groups | _spill(rows, spool)):
        content = bytearray()
        for piece in spool.read(group):
            content += piece
            if len(content) > BLOCK_BYTES:
                yield _decode_rows(content, rows.schema)
                content = bytearray()
        if content:
            yield _decode_rows(content, rows.schema)


def _spill(rows: pl.DataFrame, spool: Spool) -> set[int]:
    """Write the rows of each group, all columns as floats, and NaN for null; return the groups."""
    rows = rows.sort("group", maintain_order=True)
    values = rows.cast(pl.Float64).to_numpy(order="c")
    heads = np.flatnonzero(np.diff(values[:, rows.columns.index("group")], prepend=-1))
    groups = rows["group"].gather(heads).to_list()
    for group, (start, end) in zip(groups, pairwise([*heads, len(values)]), strict=True):
        spool.add(group, values[start:end].tobytes())
    return set(groups)


def _decode_rows(content: bytearray, schema: pl.Schema) -> pl.DataFrame:
    values = np.frombuffer(content).reshape(-1, len(schema))
    return pl.DataFrame(values, schema.names()).fill_nan(None).cast(schema)
