"""Changes from fix to fix: kernel and plain integers agree, and give the change of the angle."""

import math
from collections import defaultdict
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from fleet_slip.catalog.course import MAX_CHANGE_RAD, TURNED, course_units
from fleet_slip.columns.drive_columns import ColumnPlan
from fleet_slip.grams.compute import Fixes, aggregate, by_kernel, counts_of
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS, configs_with
from tests.support.counts import nearest
from tests.support.course_drives import LABEL, hostile_drive
from tests.support.logs import land, log_rows

APART = 400


def plain_changes(table: pa.Table, late: int = 0, apart: int = APART) -> dict[int, tuple[int, ...]]:
    """Tick of each change, and its last four columns, in words of plain Python."""
    rows = {row["tick"]: row for row in table.to_pylist()}
    units, changes = course_units(SIGNALS), dict[int, tuple[int, ...]]()
    ticks = math.floor(Fraction(late, 4) + Fraction(1, 2))
    for tick in rows:
        now, before = (rows.get(t + ticks, {}).get("course") for t in (tick, tick - apart))
        between = [rows.get(t, {}).get("yaw_rate") for t in range(tick - apart, tick + 1)]
        if None in (now, before, *between):
            continue
        turned = between[0] + between[-1] + 2 * sum(between[1:-1])
        remainder = Fraction(late, 4) - ticks  # of a tick, which is two counts of what is turned
        angle = Fraction(now - before, 65536) * units.turn - turned
        angle += 2 * remainder * (between[-1] - between[0])
        angle -= units.turn * nearest(angle / units.turn)
        if abs(angle) * Fraction(1, 2_000_000) <= MAX_CHANGE_RAD:
            change = nearest(angle / 200)
            slow = max(abs(between[0]), abs(between[-1])) <= 200 and abs(turned) <= 100_000
            changes[tick] = (nearest(Fraction(turned, 256)), slow, slow * change, change)
    return changes


@pytest.mark.parametrize(
    "late", [0, -11, 34, *(pytest.param(n, marks=pytest.mark.long) for n in (-40, -2, 1, 3, 80))]
)
def test_the_changes_of_a_hostile_drive_are_those_of_plain_integers(late: int) -> None:
    table = hostile_drive("a", 6000, 7)
    plan = ColumnPlan.of_set(CATALOG, "course")
    counts = counts_of(table, plan, {})
    rows, columns, _ = Fixes(course_units(SIGNALS), plan, counts, late).changes(APART)
    expected = plain_changes(table, late)
    assert len(expected) > 40
    assert counts.ticks[rows].tolist() == [0, *expected]
    assert np.isnan(columns[:, 0]).all()
    changes = columns[-4:, 1:].astype(int).tolist()
    assert list(zip(*changes, strict=True)) == list(expected.values())
    assert 0 < sum(slow for _, slow, _, _ in expected.values()) < len(expected)


@pytest.mark.parametrize("late", [0, 34])
def test_gram_rows_of_several_times_are_sums_of_the_plain_changes(
    warehouse: Warehouse, tmp_path: Path, late: int
) -> None:
    times = (Decimal("3.5"), Decimal(4), Decimal(5))
    three = '[sets.three]\ndescription = "three"\nof = "fleet"\nchange_s = [3.5, 4, 5]\n'
    warehouse = Warehouse(warehouse.root, configs_with(tmp_path / "configs", features=three))
    drives = {name: hostile_drive(name, 2000, seed) for seed, name in enumerate("ab")}
    land(warehouse, "one", *drives.values())
    files = warehouse.logs.snapshot().files
    rows = aggregate(warehouse, files, feature_set="three", delays={"car-1": late})
    assert set(rows["course_late"].to_pylist()) == {late}
    sums = defaultdict[tuple[str, str], Any](int)
    for row in rows.filter(pc.match_substring(rows["signals"], TURNED)).to_pylist():
        gram = Gram(tuple(row["signals"].split(",")), row["n"], row["sums"], row["products"])
        last = gram.restrict([TURNED, "straight", "straight_course", LABEL])
        sums[row["drive_id"], row["part"]] += np.array([*last.sums, *last.products])
    for name, table in drives.items():
        for time_s in times:
            changes = np.array([*plain_changes(table, late, int(100 * time_s)).values()])
            products = (changes.T @ changes)[np.tril_indices(4)]
            expected = [*changes.sum(axis=0).tolist(), *products.tolist()]
            assert sums[name, f"{time_s:f} s"].tolist() == expected


def test_a_log_without_a_course_has_no_changes(warehouse: Warehouse) -> None:
    table = hostile_drive("a", 1000, 1)
    land(warehouse, "one", table.drop_columns(["course", "satellite_speed"]))
    rows = by_kernel(warehouse, warehouse.logs.snapshot().files, "course")
    assert (rows["n"].to_pylist(), rows["signals"].to_pylist()) == ([1], [""])


def test_the_label_is_the_change_of_the_side_slip_angle() -> None:
    """Round several turns, with the course's and the yaw rate's grain as the only errors."""
    time = np.arange(5000) / 100
    slip, r = 0.05 * np.sin(1.3 * time), 0.6 + 0.3 * np.sin(0.5 * time)
    heading = 0.6 * time - 0.6 * np.cos(0.5 * time)
    course = np.rint((heading + slip) * 65536 / (2 * np.pi)).astype(np.int64)
    counts: dict[str, Any] = {name: np.zeros(5000, np.int16) for name in SIGNALS.inputs}
    counts["course"] = pa.array(
        ((course + 32768) % 65536 - 32768).astype(np.int16), mask=np.arange(5000) % 10 != 0
    )
    counts["yaw_rate"] = np.rint(r * 10_000).astype(np.int16)
    plan = ColumnPlan.of_set(CATALOG, "course")
    loaded = counts_of(log_rows("a", counts), plan, {})
    rows, columns, _ = Fixes(course_units(SIGNALS), plan, loaded).changes(APART)
    rows, columns = rows[1:], columns[:, 1:]
    assert len(rows) == 460
    changed = slip[rows] - slip[rows - APART]
    assert np.abs(columns[-1] * 1e-4 - changed).max() < 3e-4
    turned = heading[rows] - heading[rows - APART]
    assert np.abs(columns[-4] * 1.28e-4 - turned).max() < 2e-4


def test_a_turn_is_a_whole_number_of_integrated_counts() -> None:
    units = course_units(SIGNALS)
    assert (units.turn, units.divisor) == (12_566_371, 13_107_200)
    assert units.turn * 0.5e-6 == pytest.approx(2 * math.pi, rel=4e-8)
