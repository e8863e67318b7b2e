"""The changes from fix to fix of one drive, as `catalog/course.py` defines them.

Only rows with a fix are kept, at most one in ten: they fit into memory.
"""

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.course import COARSER, COURSE, CourseUnits, split_late
from fleet_slip.catalog.signals import HALF_TURN
from fleet_slip.columns.drive_columns import DriveCounts, Workspace


class Fixes:
    """The rows of a drive that have a fix."""

    def __init__(
        self, units: CourseUnits, workspace: Workspace, drive: DriveCounts, late: int = 0
    ) -> None:
        """Find those of the loaded drive, its course and yaw rate last, `late` by so much."""
        self.units = units
        self.ticks = drive.ticks.astype(np.int64)
        whole, self.gain = split_late(late)
        self.at, self.course = _fixes(drive, self.ticks, whole)
        self.yaw_rate = np.empty(len(self.ticks))  # of all rows, NaN where it is missing
        values: list[FloatArray] = []
        clipped: list[FloatArray] = []
        self.first_clipped = np.zeros(0)
        for rows, block, here in workspace.blocks(drive):
            self.yaw_rate[rows] = block[-1]
            begin, end = np.searchsorted(self.at, (rows.start, rows.stop))
            fixed = self.at[begin:end] - rows.start
            values.append(block[:-2].take(fixed, axis=1))
            clipped.append(here[fixed])
            self.first_clipped = self.first_clipped if rows.start else here[:1].copy()
        self.counts, self.clipped = np.concatenate(values, axis=1), np.concatenate(clipped)

    def changes(self, apart: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the changes between fixes that are so many ticks apart.

        The rows with a change, their columns, which end in `BESIDE` and the label and are NaN where
        missing, shape (columns, changes), and how many were clipped in each.
        """
        at, yaw_rate, units = self.at, self.yaw_rate, self.units
        before, now = _pairs(self.ticks[at], apart)
        turned, known = _twice_turned(self.ticks, yaw_rate, at[before], at[now])
        before, now, turned = before[known], now[known], turned[known]
        rest = self.gain * (yaw_rate[at[now]] - yaw_rate[at[before]]).astype(np.int64)
        change, sound = _change(units, self.course[now] - self.course[before], turned, rest)
        before, now, turned, change = before[sound], now[sound], turned[sound], change[sound]
        # Straight on by the yaw rate at both fixes and in between.
        fastest = np.maximum(np.abs(yaw_rate[at[before]]), np.abs(yaw_rate[at[now]]))
        straight = (fastest <= units.slow) & (np.abs(turned) <= units.unturned)
        beside = [_rounded(turned, COARSER), straight, straight * change]  # `BESIDE`
        began = self.ticks[:1] == 0  # no change: so a drive without a course is remembered
        first, size = int(began.sum()), len(self.counts)
        columns = np.full((size + len(beside) + 1, first + len(now)), np.nan)
        columns[:size, first:] = self.counts.take(now, axis=1)
        columns[:size, first:] -= self.counts.take(before, axis=1)
        columns[size:, first:] = [*beside, change]
        clipped = np.concatenate([self.first_clipped[began], self.clipped[now]])
        return np.concatenate([np.flatnonzero(began), at[now]]), columns, clipped


def _fixes(drive: DriveCounts, ticks: IntArray, whole: int) -> tuple[IntArray, IntArray]:
    fixed = np.flatnonzero(drive.present.get(COURSE, np.ones(len(ticks), dtype=np.bool_)))
    place = np.searchsorted(ticks, ticks[fixed] - whole)
    there = ticks[np.minimum(place, len(ticks) - 1)] == ticks[fixed] - whole
    return place[there], drive.counts[COURSE][fixed[there]].astype(np.int64)


def _pairs(ticks: IntArray, apart: int) -> tuple[IntArray, IntArray]:
    if not ticks.size:
        return ticks, ticks
    place = np.minimum(np.searchsorted(ticks, ticks - apart), ticks.size - 1)
    later = np.flatnonzero(ticks[place] == ticks - apart)
    return place[later], later


def _twice_turned(
    ticks: IntArray, yaw_rate: FloatArray, before: IntArray, now: IntArray
) -> tuple[IntArray, BoolArray]:
    """Return J between pairs of rows, and where no tick's yaw rate is missing in between."""
    missing = np.isnan(yaw_rate)
    counts = np.where(missing, 0.0, yaw_rate).astype(np.int64)
    total, gaps = np.cumsum(counts), np.cumsum(missing)
    turned = 2 * (total[now] - total[before]) - counts[now] + counts[before]
    whole = ticks[now] - ticks[before] == now - before
    return turned, whole & (gaps[now] == gaps[before]) & ~missing[before]


def _change(
    units: CourseUnits, course: IntArray, turned: IntArray, rest: IntArray
) -> tuple[IntArray, BoolArray]:
    """Return the change of the side-slip angle in counts of the label, and where it is one."""
    left = units.turn * course - 2 * HALF_TURN * turned + rest
    whole = 2 * HALF_TURN * units.turn
    left -= whole * _rounded(left, whole)
    return _rounded(left, units.divisor), np.abs(left) <= units.largest


def _rounded(number: IntArray, divisor: int) -> IntArray:
    half: IntArray = (2 * np.abs(number) + divisor) // (2 * divisor)
    return np.sign(number) * half
