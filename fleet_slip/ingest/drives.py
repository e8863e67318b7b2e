"""Cuts checked rows into drives: uninterrupted segments, collected until they end."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO

import numpy as np
import polars as pl

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.ingest.checked_columns import describe_refused, no_rows
from fleet_slip.ingest.columns import TimeBase
from fleet_slip.ingest.formats.source import Spool
from fleet_slip.ingest.resampling import STEP_S, TIME_EPSILON_S

MAX_DRIVE_S = 2**19 * STEP_S
"""A longer stretch is cut after this time, some 87 minutes, so that a drive fits into memory."""


_GROUP = np.dtype(
    [
        ("last", "f8"),  # time of the last row
        ("kept", "f8"),  # of the last one that is not isolated
        ("latest", "f8"),  # the latest time of the stretch
        ("start", "f8"),  # its first time
        ("segment", "i8"),  # number of the open segment
        ("piece", "i8"),  # index of the segment in its stretch
    ]
)
_UNSEEN = np.array((np.nan, np.nan, np.nan, np.nan, -1, -1), dtype=_GROUP)


class DriveCutter:
    """Assigns every row to a segment, which becomes a drive, and rejects rows out of order.

    A group, such as a car, has stretches, and these have segments. A step in time larger than
    `split_gap_s`, forward or back, begins a stretch, and `longest_s` ends a segment. A row that far
    from both neighbours is `isolated`, so that one wrong time stamp does not cut a drive.
    `time_duplicate` and `time_backwards` are rows not later than all earlier rows of their stretch.
    The result does not depend on the blocks: a row that needs the next one waits for it.
    """

    def __init__(self, base: TimeBase, longest_s: float = MAX_DRIVE_S) -> None:
        """Set the gap that ends a drive, and the maximum duration of a segment."""
        self._gap_s = base.split_gap_s + TIME_EPSILON_S
        self._longest_s = longest_s
        self._waiting: pl.DataFrame | None = None
        self._segments = 0
        self._state = np.empty(0, dtype=_GROUP)
        """The state of each group."""
        self.ended: list[int] = []
        """Segments that the last block ended, in an order that does not depend on blocks."""

    def cut(self, rows: pl.DataFrame, *, last: bool) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Return the rows of a block with their `segment`, together; and the misplaced ones."""
        self.ended = []
        several = "base" in rows.columns
        if self._waiting is not None:
            rows = pl.concat([self._waiting, rows])
        if rows.is_empty():
            return rows.with_columns(pl.lit(0, pl.Int64).alias("segment")), no_rows()
        if several:
            rows = rows.sort("group", "time", maintain_order=True)
        elif not rows["group"].is_sorted():
            rows = rows.sort("group", maintain_order=True)
        more = int(rows["group"][-1]) + 1 - self._state.size
        if more > 0:
            self._state = np.concatenate([self._state, np.full(more, _UNSEEN, dtype=_GROUP)])
        alone, waiting, known_at = self._isolated(rows, last=last)
        self._waiting = rows.filter(pl.Series(waiting)) if waiting.any() else None
        refused = [describe_refused(rows, alone, "isolated")]
        unsettled = alone | waiting
        if unsettled.any():
            rows, known_at = rows.filter(pl.Series(~unsettled)), known_at[~unsettled]
        rows, before = self._number_segments(rows, known_at)
        if not several:
            time = rows["time"].to_numpy()
            twice, backwards = time == before, time < before
            refused += [
                describe_refused(rows, twice, "time_duplicate"),
                describe_refused(rows, backwards, "time_backwards"),
            ]
            if (disordered := twice | backwards).any():
                rows = rows.filter(pl.Series(~disordered))
        return rows, pl.concat(refused)

    def _isolated(
        self, rows: pl.DataFrame, *, last: bool
    ) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Return which rows are isolated, which wait for the next, and which row shows that."""
        group, time = rows["group"].to_numpy(), rows["time"].to_numpy()
        first, end = _ends(group)
        before = np.concatenate([[np.nan], time[:-1]])
        before[first] = self._state["last"][group[first]]
        is_far = ~(np.abs(time - before) <= self._gap_s)
        far_next = np.concatenate([is_far[1:], [True]])
        far_next[end] = True
        alone = is_far & far_next
        waiting = np.zeros(alone.size, dtype=np.bool_)
        if not last:
            waiting[end] = alone[end]
            alone[end] = False
        self._state["last"][group[end]] = np.where(waiting[end], before[end], time[end])
        # Rows of several time bases can be ordered by their times only.
        number = time if "base" in rows.columns else rows["row"].to_numpy().astype(np.float64)
        known_at = np.concatenate([number[1:], [np.inf]])
        known_at[end] = np.inf
        return alone, waiting, np.where(is_far, known_at, number)

    def _number_segments(
        self, rows: pl.DataFrame, known_at: FloatArray
    ) -> tuple[pl.DataFrame, FloatArray]:
        """Return the rows with their segments, and the latest earlier time of their stretch.

        Lists ended segments in the order in which their end is detected. Example for one group,
        with `split_gap_s` = 1 and `longest_s` = 2: times 0, 1, 2, 3, 9 are in the segments
        0, 0, 1, 1, 2, since the first one ends after 2 s, and 9 follows a gap.
        """
        group, time, seen = rows["group"].to_numpy(), rows["time"].to_numpy(), self._state
        first, end = _ends(group)
        is_first = np.zeros(time.size, dtype=np.bool_)
        is_first[first] = True
        before = np.concatenate([[np.nan], time[:-1]])
        before[first] = seen["kept"][group[first]]
        begins = ~(np.abs(time - before) <= self._gap_s)
        before[first] = seen["latest"][group[first]]
        before[begins] = np.nan
        latest = time
        if not (begins | (time > before)).all():
            latest, before = _latest(time, before, begins | is_first)
        heads = np.flatnonzero(begins | is_first)
        start_of = np.where(begins[heads], time[heads], seen["start"][group[heads]])
        start = np.repeat(start_of, np.diff(np.append(heads, time.size)))
        piece = ((latest - start) // self._longest_s).astype(np.int64)
        piece_before = np.concatenate([[-1], piece[:-1]])
        piece_before[first] = seen["piece"][group[first]]
        begins |= piece != piece_before
        heads = np.flatnonzero(begins | is_first)
        fresh, open_segment = begins[heads], seen["segment"][group[heads]]
        segment_of = np.where(fresh, self._segments + np.cumsum(fresh) - 1, open_segment)
        self._segments += int(fresh.sum())
        before_head = np.where(
            is_first[heads], open_segment, np.concatenate([[-1], segment_of[:-1]])
        )
        over = fresh & (before_head >= 0)
        order = np.lexsort((group[heads[over]], known_at[heads[over]]))
        self.ended += before_head[over][order].tolist()
        segments = np.repeat(segment_of, np.diff(np.append(heads, time.size)))
        now = {"kept": time, "latest": latest, "start": start, "segment": segments, "piece": piece}
        for name, values in now.items():
            seen[name][group[end]] = values[end]
        return rows.with_columns(pl.Series("segment", segments)), before

    def open_segments(self) -> list[int]:
        """Return the segments that no block has ended, by group."""
        return [int(segment) for segment in self._state["segment"] if segment >= 0]


def sample_intervals_s(rows: pl.DataFrame) -> dict[int, float]:
    """Return the median time between two rows of each time base; the only one is number 0."""
    several = "base" in rows.columns
    bases = rows.partition_by("base", as_dict=True) if several else {(0,): rows}
    intervals_s = {}
    for (number,), base in bases.items():
        step_s, segment = np.diff(base["time"].to_numpy()), base["segment"].to_numpy()
        median = pl.Series(step_s[segment[1:] == segment[:-1]]).median()
        intervals_s[number] = median if isinstance(median, float) and median else STEP_S
    return intervals_s


def _ends(group: IntArray) -> tuple[IntArray, IntArray]:
    """Return where each group's rows begin, and the last of them."""
    if not group.size:
        nothing = np.empty(0, dtype=np.int64)
        return nothing, nothing
    changes = np.flatnonzero(np.diff(group)) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes - 1, [group.size - 1]])


def _latest(
    time: FloatArray, before: FloatArray, heads: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the latest time up to each row of its stretch, and before it (NaN for the first)."""
    seeded = np.where(heads & ~np.isnan(before), np.maximum(time, before), time)
    frame = pl.DataFrame({"time": seeded, "stretch": np.cumsum(heads)})
    latest = frame.select(pl.col("time").cum_max().over("stretch"))["time"].to_numpy()
    shifted = np.concatenate([[np.nan], latest[:-1]])
    return latest, np.where(heads, before, shifted)


# The rows of open drives, few of them in memory.

MAX_OPEN_VALUES = 2**21
"""Maximum values of open drives in memory; the others are in a temporary file."""
MAX_SEGMENTS_AT_ONCE = 64
"""Segments taken out of blocks at once: thousands of small frames take much memory."""
MAX_SINGLE_PIECES, BUNDLED_GROUPS = 512, 128
"""Maximum number of segments that are spilled one by one; beyond it groups are bundled."""


@dataclass(frozen=True)
class DriveRows:
    """The rows of one drive by time base, in chunks that are not copied together.

    Each of several bases has the signals with values in it.
    """

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
    def frame(self) -> pl.DataFrame:
        """All rows in one frame."""
        return pl.concat(self.bases.values(), how="diagonal")

    def column(self, name: str) -> pl.Series:
        """Return a column of the only base."""
        (rows,) = self.bases.values()
        return rows[name] if name in rows.columns else pl.repeat(np.nan, rows.height, eager=True)

    def samples(self, name: str) -> pl.DataFrame:
        """Return `time` and a signal where it has a value, by time."""
        frames = [rows.select("time", name) for rows in self.bases.values() if name in rows.columns]
        if not frames:
            return pl.DataFrame(schema={"time": pl.Float64, name: pl.Float64})
        samples = pl.concat(frames).drop_nulls(name)
        return samples if samples["time"].is_sorted() else samples.sort("time", maintain_order=True)


class OpenDrives:
    """The rows of open segments, few of them in memory.

    If hundreds of segments are open at once, their rows are spilled in bundles of groups, and no
    segment is yielded before the end of the file.
    """

    def __init__(self) -> None:
        """Begin without rows."""
        self._blocks: list[pl.DataFrame] = []
        self._in_memory = 0
        self._spool = Spool()
        self._bundled = False
        self._ended: list[int] = []
        self._group_of: dict[int, int] = {}
        """The group of each segment with spilled rows."""

    def add(self, rows: pl.DataFrame) -> None:
        """Keep rows with their segment."""
        if rows.height:
            self._blocks.append(rows)
            self._in_memory += rows.height * rows.width

    def take(self, segments: Sequence[int], *, last: bool) -> Iterator[DriveRows]:
        """Yield the rows of segments and release them; `last` for the end of the file."""
        if not self._bundled:
            yield from self._take(segments)
            return
        self._ended += segments
        if last:
            yield from self._unbundled()

    def _take(self, segments: Sequence[int]) -> Iterator[DriveRows]:
        for start in range(0, len(segments), MAX_SEGMENTS_AT_ONCE):
            chunk = segments[start : start + MAX_SEGMENTS_AT_ONCE]
            rows_in_memory = self._release(chunk)
            for segment in chunk:
                self._group_of.pop(segment, None)
                spilled = map(pl.read_ipc_stream, self._spool.take(segment))
                if pieces := [*spilled, *rows_in_memory[segment]]:
                    yield DriveRows(_by_base(pieces))

    def _release(self, segments: Sequence[int]) -> dict[int, list[pl.DataFrame]]:
        """Take the rows of segments out of memory."""
        rows_of_segment = defaultdict[int, list[pl.DataFrame]](list)
        is_taken = pl.col("segment").is_in(segments)
        for _ in range(len(self._blocks)):
            rows = self._blocks.pop(0)
            for run in rows.filter(is_taken).partition_by("segment", maintain_order=True):
                rows_of_segment[run["segment"][0]].append(run)
            self._in_memory -= rows.height * rows.width
            self.add(rows.filter(~is_taken))
        return rows_of_segment

    def _unbundled(self) -> Iterator[DriveRows]:
        """Yield the rows of all segments, bundle by bundle, and in each as the segments ended."""
        self._spill_rows(bundled=True)
        bundles = defaultdict[int, list[int]](list)
        for segment in self._ended:
            bundles[self._group_of.get(segment, 0) // BUNDLED_GROUPS].append(segment)
        for bundle, segments in sorted(bundles.items()):
            for piece in self._spool.take(("bundle", bundle)):
                self.add(pl.read_ipc_stream(piece))
                if self._in_memory > MAX_OPEN_VALUES:
                    self._spill_rows(bundled=False)
            if self._blocks:  # hundreds of small frames a segment would take much memory
                self._blocks = [pl.concat(self._blocks, rechunk=True)]
            yield from self._take(segments)

    def spill(self) -> None:
        """Spill the rows if they are many. Raises `InputError` if the disk is full."""
        if self._in_memory > MAX_OPEN_VALUES:
            segments = pl.concat([rows["segment"] for rows in self._blocks]).n_unique()
            self._bundled |= segments > MAX_SINGLE_PIECES
            self._spill_rows(bundled=self._bundled)

    def _spill_rows(self, *, bundled: bool) -> None:
        """Spill all rows, by bundles or by segments."""
        if not self._blocks:
            return
        rows = pl.concat(self._blocks)
        self._blocks, self._in_memory = [], 0
        heads = rows.select("segment", "group").unique("segment")
        self._group_of.update(zip(heads["segment"], heads["group"], strict=True))
        key = (pl.col("group") // BUNDLED_GROUPS if bundled else pl.col("segment")).alias("key")
        pieces = rows.with_columns(key).partition_by("key", as_dict=True, include_key=False)
        for (number,), piece in pieces.items():
            content = BytesIO()
            piece.write_ipc_stream(content, compression="lz4")
            self._spool.add(("bundle", number) if bundled else number, content.getvalue())


def _by_base(pieces: list[pl.DataFrame]) -> dict[int, pl.DataFrame]:
    """Return the rows of each time base, with the columns that have values in it."""
    if "base" not in pieces[0].columns:
        return {0: pl.concat(pieces)}
    bases = defaultdict[int, list[pl.DataFrame]](list)
    for piece in pieces:
        for rows in piece.drop("segment").partition_by("base", maintain_order=True):
            filled = rows.select(column for column in rows if column.null_count() < rows.height)
            bases[rows["base"][0]].append(filled)
    return {base: pl.concat(bases[base], how="diagonal") for base in sorted(bases)}
