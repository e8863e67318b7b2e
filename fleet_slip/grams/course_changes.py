"""Changes between satellite fixes of one drive, as `catalog/course.py` defines them.

Only rows with a fix are in memory: at most one in ten.
"""

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.course import COARSER, COURSE, CourseUnits, split_late
from fleet_slip.catalog.signals import HALF_TURN
from fleet_slip.columns.drive_columns import DriveCounts, Workspace


class Fixes:
    """Rows of a drive that have a fix."""

    def __init__(
        self, units: CourseUnits, workspace: Workspace, drive: DriveCounts, delay: int = 0
    ) -> None:
        """Find the fixes of a drive whose course is late by `delay` parts of a tick.

        Course and yaw rate are the last columns of the workspace.
        """
        self.units = units
        self.ticks = drive.ticks.astype(np.int64)
        delay_ticks, self.gain = split_late(delay)
        self.rows, self.course = _find_fixes(drive, self.ticks, delay_ticks)
        self.yaw_rate = np.empty(len(self.ticks))  # of all rows, NaN where it is missing
        values: list[FloatArray] = []
        clipped: list[FloatArray] = []
        self.first_clipped = np.zeros(0)
        for rows, block, block_clipped in workspace.blocks(drive):
            self.yaw_rate[rows] = block[-1]
            begin, end = np.searchsorted(self.rows, (rows.start, rows.stop))
            fixed = self.rows[begin:end] - rows.start
            values.append(block[:-2].take(fixed, axis=1))
            clipped.append(block_clipped[fixed])
            if not rows.start:
                self.first_clipped = block_clipped[:1].copy()
        self.counts, self.clipped = np.concatenate(values, axis=1), np.concatenate(clipped)

    def changes(self, duration: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the changes between fixes that are `duration` ticks apart.

        Returns the rows of the later fixes, the columns, shape (columns, changes), which end with
        `BESIDE` and the label and are NaN where missing, and the number of clipped values of each.
        """
        rows, yaw_rate, units = self.rows, self.yaw_rate, self.units
        before, now = _pair_fixes(self.ticks[rows], duration)
        turned, complete = _twice_turned(self.ticks, yaw_rate, rows[before], rows[now])
        before, now, turned = before[complete], now[complete], turned[complete]
        by_delay = self.gain * (yaw_rate[rows[now]] - yaw_rate[rows[before]]).astype(np.int64)
        course_change = self.course[now] - self.course[before]
        change, plausible = _sideslip_change(units, course_change, turned, by_delay)
        before, now, turned, change = (v[plausible] for v in (before, now, turned, change))
        # Straight driving by the yaw rate at both fixes and in between.
        fastest = np.maximum(np.abs(yaw_rate[rows[before]]), np.abs(yaw_rate[rows[now]]))
        straight = (fastest <= units.slow) & (np.abs(turned) <= units.unturned)
        auxiliary = [_divide_rounded(turned, COARSER), straight, straight * change]  # `BESIDE`
        # The first row has no change: it records a drive without a course.
        is_start = self.ticks[:1] == 0
        offset, size = int(is_start.sum()), len(self.counts)
        columns = np.full((size + len(auxiliary) + 1, offset + len(now)), np.nan)
        columns[:size, offset:] = self.counts.take(now, axis=1)
        columns[:size, offset:] -= self.counts.take(before, axis=1)
        columns[size:, offset:] = [*auxiliary, change]
        clipped = np.concatenate([self.first_clipped[is_start], self.clipped[now]])
        return np.concatenate([np.flatnonzero(is_start), rows[now]]), columns, clipped


def _find_fixes(drive: DriveCounts, ticks: IntArray, delay_ticks: int) -> tuple[IntArray, IntArray]:
    """Return the rows that the fixes are of, `delay_ticks` before they arrive, and the course."""
    fixed = np.flatnonzero(drive.present.get(COURSE, np.ones(len(ticks), dtype=np.bool_)))
    rows = np.searchsorted(ticks, ticks[fixed] - delay_ticks)
    exists = ticks[np.minimum(rows, len(ticks) - 1)] == ticks[fixed] - delay_ticks
    return rows[exists], drive.counts[COURSE][fixed[exists]].astype(np.int64)


def _pair_fixes(ticks: IntArray, duration: int) -> tuple[IntArray, IntArray]:
    """Return the indices of the fixes that are `duration` ticks apart, the earlier ones first."""
    if not ticks.size:
        return ticks, ticks
    before = np.minimum(np.searchsorted(ticks, ticks - duration), ticks.size - 1)
    now = np.flatnonzero(ticks[before] == ticks - duration)
    return before[now], now


def _twice_turned(
    ticks: IntArray, yaw_rate: FloatArray, before: IntArray, now: IntArray
) -> tuple[IntArray, BoolArray]:
    """Return J between pairs of rows, and a mask of pairs without a missing yaw rate between."""
    missing = np.isnan(yaw_rate)
    counts = np.where(missing, 0.0, yaw_rate).astype(np.int64)
    total, gaps = np.cumsum(counts), np.cumsum(missing)
    turned = 2 * (total[now] - total[before]) - counts[now] + counts[before]
    is_gapless = ticks[now] - ticks[before] == now - before
    return turned, is_gapless & (gaps[now] == gaps[before]) & ~missing[before]


def _sideslip_change(
    units: CourseUnits, course: IntArray, turned: IntArray, by_delay: IntArray
) -> tuple[IntArray, BoolArray]:
    """Return the change of the side-slip angle in counts of the label, and the plausible ones."""
    change = units.turn * course - 2 * HALF_TURN * turned + by_delay
    full_turn = 2 * HALF_TURN * units.turn
    change -= full_turn * _divide_rounded(change, full_turn)
    return _divide_rounded(change, units.divisor), np.abs(change) <= units.largest


def _divide_rounded(number: IntArray, divisor: int) -> IntArray:
    quotient: IntArray = (2 * np.abs(number) + divisor) // (2 * divisor)
    return np.sign(number) * quotient
