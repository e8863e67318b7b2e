"""Cuts checked rows into drives: uninterrupted segments, collected until they end."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import NamedTuple

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
        ("time", "f8"),  # of the last one that is not isolated
        ("latest", "f8"),  # the latest time of the stretch
        ("start", "f8"),  # its first time
        ("segment", "i8"),  # number of the open segment
        ("piece", "i8"),  # index of the segment in its stretch
    ]
)
_UNSEEN = np.array((np.nan, np.nan, np.nan, np.nan, -1, -1), dtype=_GROUP)


class CutRows(NamedTuple):
    """The rows of a block with their `segment`, the misplaced rows, and the segments that ended.

    The order of ended segments does not depend on blocks.
    """

    rows: pl.DataFrame
    refused: pl.DataFrame
    ended: list[int]


class DriveCutter:
    """Assigns every row to a segment, which becomes a drive, and rejects rows out of order.

    A group, such as a car, has stretches, and these have segments. A step in time larger than
    `split_gap_s`, forward or back, begins a stretch, and `longest_s` ends a segment. A row that far
    from both neighbours is `isolated`, so that one wrong time stamp does not cut a drive.
    `time_duplicate` and `time_backwards` are rows not later than all earlier rows of their stretch.
    The result does not depend on the blocks: a row that needs the next one waits for it.
    """

    def __init__(
        self, base: TimeBase, longest_s: float = MAX_DRIVE_S, *, is_grouped: bool = False
    ) -> None:
        """Set the gap that ends a drive, and the maximum duration of a segment.

        If the file `is_grouped`, the rows of each group are together: the next group ends it.
        """
        self._gap_s = base.split_gap_s + TIME_EPSILON_S
        self._longest_s, self._is_grouped = longest_s, is_grouped
        self._waiting: pl.DataFrame | None = None
        self._segments = 0
        self._state = np.empty(0, dtype=_GROUP)
        """The state of each group."""

    def cut(self, rows: pl.DataFrame, *, last: bool) -> CutRows:
        """Return the rows of a block, those of a segment together; `last` ends all segments."""
        if not last and self._waiting is None and self._continues(rows):
            number = int(self._state["segment"][rows["group"][0]])
            segment = pl.lit(number, pl.Int64).alias("segment")
            return CutRows(rows.with_columns(segment), no_rows(), [])
        several = "base" in rows.columns
        if self._waiting is not None:
            rows = pl.concat([self._waiting, rows])
        if rows.is_empty():
            nothing = rows.with_columns(pl.lit(0, pl.Int64).alias("segment"))
            return CutRows(nothing, no_rows(), self._end_before(self._state.size) if last else [])
        if several:
            rows = rows.sort("group", "time", maintain_order=True)
        elif not rows["group"].is_sorted():
            rows = rows.sort("group", maintain_order=True)
        group = rows["group"]
        new_groups = int(group[-1]) + 1 - self._state.size
        if new_groups > 0:
            self._state = np.concatenate([self._state, np.full(new_groups, _UNSEEN, dtype=_GROUP)])
        alone, waiting, decided_at = self._isolated(rows, last=last)
        self._waiting = rows.filter(pl.Series(waiting)) if waiting.any() else None
        refused = [describe_refused(rows, alone, "isolated")]
        unsettled = alone | waiting
        if unsettled.any():
            rows, decided_at = rows.filter(pl.Series(~unsettled)), decided_at[~unsettled]
        rows, before, ended = self._number_segments(rows, decided_at)
        if not several:
            time = rows["time"].to_numpy()
            twice, backwards = time == before, time < before
            refused += [
                describe_refused(rows, twice, "time_duplicate"),
                describe_refused(rows, backwards, "time_backwards"),
            ]
            if (disordered := twice | backwards).any():
                rows = rows.filter(pl.Series(~disordered))
        if last:
            ended += self._end_before(self._state.size)
        elif self._is_grouped:
            ended = sorted(ended + self._end_before(int(group[-1])))
        misplaced = pl.concat(refused) if any(bad.height for bad in refused) else no_rows()
        return CutRows(rows, misplaced, ended)

    def _continues(self, rows: pl.DataFrame) -> bool:
        """Return True if all rows continue the open segment of one group, in the order of time.

        Most blocks do; then the state is updated.
        """
        if not rows.height or "base" in rows.columns:
            return False
        group, time = rows["group"], rows["time"].to_numpy()
        if group[0] >= self._state.size or group.min() != group.max():
            return False
        state = self._state[group[0]]
        step_s = np.diff(time, prepend=state["latest"])
        is_steady = step_s.min() > 0 and step_s.max() <= self._gap_s  # False for NaN
        piece = (time[-1] - state["start"]) // self._longest_s
        is_ordered = state["last"] == state["time"] == state["latest"]
        if not is_steady or not is_ordered or piece != state["piece"]:
            return False
        for name in ("last", "time", "latest"):
            self._state[name][group[0]] = time[-1]
        return True

    def _isolated(
        self, rows: pl.DataFrame, *, last: bool
    ) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Return which rows are isolated, which wait for the next, and which row decides that."""
        group, time = rows["group"].to_numpy(), rows["time"].to_numpy()
        first, end = _ends(group)
        before = self._previous("last", time, group, first)
        is_far = ~(np.abs(time - before) <= self._gap_s)
        far_next = np.append(is_far[1:], True)
        far_next[end] = True
        alone = is_far & far_next
        waiting = np.zeros(alone.size, dtype=np.bool_)
        if not last:
            may_wait = end[-1:] if self._is_grouped else end
            waiting[may_wait] = alone[may_wait]
            alone[may_wait] = False
        self._state["last"][group[end]] = np.where(waiting[end], before[end], time[end])
        # Rows of several time bases can be ordered by their times only.
        number = time if "base" in rows.columns else rows["row"].to_numpy().astype(np.float64)
        decided_at = np.append(number[1:], np.inf)
        decided_at[end] = np.inf
        return alone, waiting, np.where(is_far, decided_at, number)

    def _number_segments(
        self, rows: pl.DataFrame, decided_at: FloatArray
    ) -> tuple[pl.DataFrame, FloatArray, list[int]]:
        """Return the rows with segments, the latest earlier time of their stretch, ended segments.

        Ended segments are in the order in which their end is detected. Example for one group,
        with `split_gap_s` = 1 and `longest_s` = 2: times 0, 1, 2, 3, 9 are in the segments
        0, 0, 1, 1, 2, since the first one ends after 2 s, and 9 follows a gap.
        """
        group, time, state = rows["group"].to_numpy(), rows["time"].to_numpy(), self._state
        first, end = _ends(group)
        is_first = np.zeros(time.size, dtype=np.bool_)
        is_first[first] = True

        # 1. A stretch begins after a gap; its start, and the latest time in it up to each row.
        step_s = time - self._previous("time", time, group, first)
        begins = ~(np.abs(step_s) <= self._gap_s)
        before = self._previous("latest", time, group, first)
        before[begins] = np.nan
        latest = time
        if not (begins | (time > before)).all():
            latest, before = _latest(time, before, begins | is_first)
        heads = np.flatnonzero(begins | is_first)
        start_s = np.where(begins[heads], time[heads], state["start"][group[heads]])
        start_s = np.repeat(start_s, np.diff(heads, append=time.size))

        # 2. A long stretch has several segments, which are numbered in the order of rows.
        piece = ((latest - start_s) // self._longest_s).astype(np.int64)
        begins |= piece != self._previous("piece", piece, group, first)
        heads = np.flatnonzero(begins | is_first)
        is_new, is_first_head = begins[heads], is_first[heads]
        open_segment = state["segment"][group[heads]]
        segment = np.where(is_new, self._segments + np.cumsum(is_new) - 1, open_segment)
        self._segments += int(is_new.sum())

        # 3. A new segment of a group ends the one before.
        before_head = np.where(is_first_head, open_segment, np.roll(segment, 1))
        ends = is_new & (before_head >= 0)
        order = np.lexsort((group[heads[ends]], decided_at[heads[ends]]))
        ended: list[int] = before_head[ends][order].tolist()

        segment = np.repeat(segment, np.diff(heads, append=time.size))
        now = {"time": time, "latest": latest, "start": start_s, "segment": segment, "piece": piece}
        for name, values in now.items():
            state[name][group[end]] = values[end]
        return rows.with_columns(pl.Series("segment", segment)), before, ended

    def _previous(
        self, name: str, values: FloatArray | IntArray, group: IntArray, first: IntArray
    ) -> FloatArray:
        """Return the value at the row before in each group; for its first row, of the state."""
        before = np.roll(values, 1).astype(np.float64)
        before[first] = self._state[name][group[first]]
        return before

    def _end_before(self, group: int) -> list[int]:
        """End the open segments of all groups before a group; return them by group."""
        open_segment = self._state["segment"][:group]
        is_open = open_segment >= 0
        ended: list[int] = open_segment[is_open].tolist()
        open_segment[is_open] = -1
        return ended


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
    return np.append(0, changes), np.append(changes - 1, group.size - 1)


def _latest(
    time: FloatArray, before: FloatArray, heads: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the latest time up to each row of its stretch, and before it (NaN for the first)."""
    seeded = np.where(heads & ~np.isnan(before), np.maximum(time, before), time)
    frame = pl.DataFrame({"time": seeded, "stretch": np.cumsum(heads)})
    latest = frame.select(pl.col("time").cum_max().over("stretch"))["time"].to_numpy()
    return latest, np.where(heads, before, np.roll(latest, 1))


# The rows of open drives, few of them in memory.

MAX_OPEN_VALUES = 2**23
"""Maximum values of open drives in memory, 64 MiB; the others are in a temporary file.

A drive of 87 minutes at 100 Hz with 14 signals fits: drives whose rows are together are not
spilled. Of hundreds of open drives it is a quarter, as each takes memory of its own.
"""
MANY_SEGMENTS = 64
"""Segments that end at once, for which blocks are joined: each is one piece then."""
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
        self._values = 0
        self._spool = Spool()
        self._bundled = False
        self._ended: list[int] = []
        self._group_of: dict[int, int] = {}
        """The group of each segment with spilled rows."""

    def add(self, rows: pl.DataFrame) -> None:
        """Keep rows with their segment, those of a segment together."""
        if rows.height:
            self._blocks.append(rows)
            self._values += rows.height * rows.width

    def take(self, segments: Sequence[int], *, last: bool) -> Iterator[DriveRows]:
        """Yield the rows of segments and release them; `last` for the end of the file."""
        if not self._bundled:
            yield from self._take(segments)
            return
        self._ended += segments
        if last:
            yield from self._unbundled()

    def _take(self, segments: Sequence[int]) -> Iterator[DriveRows]:
        runs = self._release(segments) if self._blocks else {}
        for segment in segments:
            self._group_of.pop(segment, None)
            spilled = map(pl.read_ipc_stream, self._spool.take(segment))
            in_memory = (rows.slice(head, height) for rows, head, height in runs.pop(segment, ()))
            if pieces := [*spilled, *in_memory]:
                yield DriveRows(_by_base(pieces))

    def _release(self, segments: Sequence[int]) -> dict[int, list[tuple[pl.DataFrame, int, int]]]:
        """Take segments out of memory; return the place of each one's rows in blocks."""
        if len(segments) > MANY_SEGMENTS:
            self._blocks = [pl.concat(self._blocks).sort("segment", maintain_order=True)]
        runs = defaultdict[int, list[tuple[pl.DataFrame, int, int]]](list)
        blocks, self._blocks, self._values = self._blocks, [], 0
        for rows in blocks:
            number = rows["segment"].to_numpy()
            first, end = _ends(number)
            height, is_taken = end + 1 - first, np.isin(number[first], segments)
            for head, n in zip(first[is_taken], height[is_taken], strict=True):
                runs[int(number[head])].append((rows, int(head), int(n)))
            if not is_taken.any():
                self.add(rows)
            elif not is_taken.all():
                self.add(rows.filter(pl.Series(np.repeat(~is_taken, height))))
        return runs

    def _unbundled(self) -> Iterator[DriveRows]:
        """Yield the rows of all segments, bundle by bundle, and in each as the segments ended."""
        self._spill_rows(bundled=True)
        bundles = defaultdict[int, list[int]](list)
        for segment in self._ended:
            bundles[self._group_of.get(segment, 0) // BUNDLED_GROUPS].append(segment)
        for bundle, segments in sorted(bundles.items()):
            for piece in self._spool.take(("bundle", bundle)):
                self.add(pl.read_ipc_stream(piece))
                if self._values > MAX_OPEN_VALUES // 4:
                    self._spill_rows(bundled=False)
            if self._blocks:  # a piece has a segment in several places
                self._blocks = [pl.concat(self._blocks).sort("segment", maintain_order=True)]
            yield from self._take(segments)

    def spill(self) -> None:
        """Spill the rows if they are many. Raises `InputError` if the disk is full."""
        if self._values <= MAX_OPEN_VALUES // 4:
            return
        segments = pl.concat([rows["segment"] for rows in self._blocks])
        if np.ptp(segments.to_numpy()) >= MAX_SINGLE_PIECES:
            self._bundled |= segments.n_unique() > MAX_SINGLE_PIECES
        if self._bundled or self._values > MAX_OPEN_VALUES:
            self._spill_rows(bundled=self._bundled)

    def _spill_rows(self, *, bundled: bool) -> None:
        """Spill all rows, by bundles or by segments."""
        if not self._blocks:
            return
        rows = pl.concat(self._blocks)
        self._blocks, self._values = [], 0
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
