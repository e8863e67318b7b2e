"""Checks the order of time and cuts rows, block by block, into drives: uninterrupted stretches."""

import itertools
from typing import NamedTuple

import numpy as np
import polars as pl

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.ingest.drives.checking import describe_refused, join_refused, no_rows
from fleet_slip.ingest.drives.resampling import STEP_S, TIME_EPSILON_S
from fleet_slip.ingest.mapping.time_base import TimeBase

LONGEST_DRIVE_S = 2**19 * STEP_S
"""A longer stretch is cut after this time, some 87 minutes, so that a drive fits into memory."""


_GROUP = np.dtype(
    [
        ("last", "f8"),  # time of the last row
        ("kept", "f8"),  # of the last one that is not isolated
        ("latest", "f8"),  # the latest time of the stretch
        ("start", "f8"),  # its first time
        ("part", "i8"),  # number of the open part
        ("piece", "i8"),  # which part of the stretch that is
    ]
)
_UNSEEN = np.array((np.nan, np.nan, np.nan, np.nan, -1, -1), dtype=_GROUP)

MOST_STRETCHES = 16
"""Irregular steps up to which a block is taken apart at them; with more it is cut as a whole."""


class _Stretch(NamedTuple):
    """Rows, and whether they are of one group at times that ascend without a gap."""

    rows: pl.DataFrame
    is_steady: bool


class DriveCutter:
    """Gives every row the number of its part, a stretch of one `group`, and refuses others.

    Within the rows of one group, in the file's order:

    * a step in time larger than `split_gap_s`, forward or back, begins a new part;
    * `isolated`: a row whose neighbours are both that far; it goes before parts are made, so one
      wild time stamp costs one row and does not cut a drive;
    * `time_duplicate`, `time_backwards`: not later than all earlier rows of its stretch;
    * a stretch is cut into parts of `longest_s` at most.

    What becomes of a row does not depend on the blocks in which rows come: what the next row
    decides waits for it.
    """

    def __init__(self, base: TimeBase, longest_s: float = LONGEST_DRIVE_S) -> None:
        """Take the gap that ends a drive, and how long a part lasts at most."""
        self._gap_s = base.split_gap_s + TIME_EPSILON_S
        self._longest_s = longest_s
        self._waiting: pl.DataFrame | None = None
        self._parts = 0
        self._state = np.empty(0, dtype=_GROUP)
        """What was seen of each group so far."""
        self.ended: list[int] = []
        """Parts that the last block ended, in an order that does not depend on blocks."""

    def cut(self, rows: pl.DataFrame, *, last: bool) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Return the rows of a block with their `part`, together; and the misplaced ones."""
        self.ended = []
        stretches = _stretches(rows, self._gap_s)
        found = [
            self._go_on(stretch, last=last and i + 1 == len(stretches))
            for i, stretch in enumerate(stretches)
        ]
        if len(found) == 1:
            return found[0]
        good, bad = zip(*found, strict=True)
        return pl.concat(good), join_refused(bad)

    def _go_on(self, stretch: "_Stretch", *, last: bool) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Cut a stretch; at once if nothing happens in it but that a part begins or goes on."""
        rows = stretch.rows
        if not stretch.is_steady or self._waiting is not None:
            return self._cut(rows, last=last)
        group, time = int(rows["group"][0]), rows["time"].to_numpy()
        if group >= self._state.size or np.isnan(self._state[group]["last"]):
            if time.size < 2 or time[-1] - time[0] >= self._longest_s:
                return self._cut(rows, last=last)
            self._grow(rows)
            self._state[group] = (np.nan, np.nan, np.nan, time[0], self._parts, 0)
            self._parts += 1
            return self._with_part(rows, group, time[-1])
        seen = self._state[group]
        if seen["part"] < 0:
            return self._cut(rows, last=last)
        near = all(abs(time[0] - seen[at]) <= self._gap_s for at in ("last", "kept"))
        piece = (time[-1] - seen["start"]) // self._longest_s
        if not near or time[0] <= seen["latest"] or piece != seen["piece"]:
            return self._cut(rows, last=last)
        return self._with_part(rows, group, time[-1])

    def _with_part(
        self, rows: pl.DataFrame, group: int, last_s: float
    ) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Return rows that are all of their group's open part."""
        for at in ("last", "kept", "latest"):
            self._state[at][group] = last_s
        part = pl.lit(int(self._state["part"][group]), pl.Int64)
        return rows.with_columns(part.alias("part")), no_rows()

    def _cut(self, rows: pl.DataFrame, *, last: bool) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Cut rows of any kind."""
        several = "base" in rows.columns
        if self._waiting is not None:
            rows = pl.concat([self._waiting, rows])
        if rows.is_empty():
            return rows.with_columns(pl.lit(0, pl.Int64).alias("part")), no_rows()
        if several:
            rows = rows.sort("group", "time", maintain_order=True)
        elif not rows["group"].is_sorted():
            rows = rows.sort("group", maintain_order=True)
        self._grow(rows)
        alone, waiting, known_at = self._isolated(rows, last=last)
        self._waiting = rows.filter(pl.Series(waiting)) if waiting.any() else None
        isolated = _refuse(rows, alone, "isolated")
        unsettled = alone | waiting
        if unsettled.any():
            settled = pl.Series(~unsettled)
            rows, known_at = rows.filter(settled), known_at[~unsettled]
        rows, before = self._number_parts(rows, known_at)
        if several:
            return rows, isolated
        time = rows["time"].to_numpy()
        twice, backwards = time == before, time < before
        disordered = twice | backwards
        if disordered.any():
            refused = [
                _refuse(rows, twice, "time_duplicate"),
                _refuse(rows, backwards, "time_backwards"),
            ]
            return rows.filter(pl.Series(~disordered)), pl.concat([isolated, *refused])
        return rows, isolated

    def _grow(self, rows: pl.DataFrame) -> None:
        """Make room for groups that were not there before."""
        more = int(rows["group"][-1]) + 1 - self._state.size
        if more > 0:
            self._state = np.concatenate([self._state, np.full(more, _UNSEEN, dtype=_GROUP)])

    def _isolated(
        self, rows: pl.DataFrame, *, last: bool
    ) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Return which rows are isolated, which wait for the next, and which row tells that."""
        group, time = rows["group"].to_numpy(), rows["time"].to_numpy()
        first, end = _ends(group)
        before = np.concatenate([[np.nan], time[:-1]])
        before[first] = self._state["last"][group[first]]
        far = ~(np.abs(time - before) <= self._gap_s)
        far_next = np.concatenate([far[1:], [True]])
        far_next[end] = True
        alone = far & far_next
        waiting = np.zeros(alone.size, dtype=np.bool_)
        if not last:
            waiting[end] = alone[end]
            alone[end] = False
        self._state["last"][group[end]] = np.where(waiting[end], before[end], time[end])
        # Of several time bases only times tell what comes first.
        number = time if "base" in rows.columns else rows["row"].to_numpy().astype(np.float64)
        known_at = np.concatenate([number[1:], [np.inf]])
        known_at[end] = np.inf
        return alone, waiting, np.where(far, known_at, number)

    def _number_parts(
        self, rows: pl.DataFrame, known_at: FloatArray
    ) -> tuple[pl.DataFrame, FloatArray]:
        """Return the rows with their parts, and the latest time of its stretch before each.

        Ended parts are told in the order in which it becomes known that they have ended.
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
        fresh, open_part = begins[heads], seen["part"][group[heads]]
        part_of = np.where(fresh, self._parts + np.cumsum(fresh) - 1, open_part)
        self._parts += int(fresh.sum())
        before_head = np.where(is_first[heads], open_part, np.concatenate([[-1], part_of[:-1]]))
        over = fresh & (before_head >= 0)
        order = np.lexsort((group[heads[over]], known_at[heads[over]]))
        self.ended += before_head[over][order].tolist()
        parts = np.repeat(part_of, np.diff(np.append(heads, time.size)))
        now = {"kept": time, "latest": latest, "start": start, "part": parts, "piece": piece}
        for name, values in now.items():
            seen[name][group[end]] = values[end]
        return rows.with_columns(pl.Series("part", parts)), before

    def open_parts(self) -> list[int]:
        """Return the parts that no block has ended, by group."""
        return [int(part) for part in self._state["part"] if part >= 0]


def sample_interval_s(rows: pl.DataFrame) -> float | None:
    """Return the usual time between two rows of a drive, the median; None without two rows."""
    rows = rows if rows["part"].is_sorted() else rows.sort("part", maintain_order=True)
    step, part = np.diff(rows["time"].to_numpy()), rows["part"].to_numpy()
    median = pl.Series(step[part[1:] == part[:-1]]).median()
    return float(median) if isinstance(median, float) else None


def sample_intervals_s(rows: pl.DataFrame) -> dict[int, float]:
    """Return the usual time between two rows of each time base; the only one is number 0."""
    if "base" not in rows.columns:
        return {0: sample_interval_s(rows) or STEP_S}
    bases = rows.partition_by("base", as_dict=True)
    return {number: sample_interval_s(base) or STEP_S for (number,), base in bases.items()}


def _stretches(rows: pl.DataFrame, gap_s: float) -> list[_Stretch]:
    """Take a block apart so that few rows are beside an irregular step, and most are steady.

    Two rows stand alone at each such step: the one that is far from the last, and the one that
    tells what it is.
    """
    if "base" in rows.columns or rows.height < 2:
        return [_Stretch(rows, is_steady=False)]
    step = np.diff(rows["time"].to_numpy())
    irregular = ~((step > 0) & (step <= gap_s)) | (np.diff(rows["group"].to_numpy()) != 0)
    heads = np.flatnonzero(irregular) + 1
    if heads.size > MOST_STRETCHES:
        return [_Stretch(rows, is_steady=False)]
    ends = np.unique(np.clip([0, *heads, *(heads + 2), rows.height], 0, rows.height)).tolist()
    return [
        _Stretch(rows.slice(start, end - start), is_steady=start not in heads)
        for start, end in itertools.pairwise(ends)
    ]


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


def _refuse(rows: pl.DataFrame, which: BoolArray, reason: str) -> pl.DataFrame:
    return describe_refused(rows, which, reason) if which.any() else no_rows()
