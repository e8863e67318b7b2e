"""Changes from fix to fix: kernel, SQL and plain integers agree, and tell the angle's change."""

import math
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from fleet_slip.catalogue.course import LARGEST_RAD, TURNED, course_units
from fleet_slip.catalogue.features import FeatureSet, features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import Workspace
from fleet_slip.columns.plan import ColumnPlan
from fleet_slip.grams.check import grams_of
from fleet_slip.grams.compute import (
    aggregate,
    by_sql,
    counts_of,
    course_changes,
    find_fixes,
    wide_grams,
)
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, random_counts

APART = 400
LABEL = catalogue().label


def hostile_drive(name: str, rows: int, seed: int, *, every: int = 10) -> pa.Table:
    """A drive with fixes that fail, missing values, holes in time, and a course that goes round."""
    rng = np.random.default_rng(seed)
    counts: dict[str, Any] = random_counts(rng, rows)
    for wheel in ("fl", "fr", "rl", "rr"):
        counts[f"wheel_{wheel}"] = rng.integers(0, 12_000, rows).astype(np.int16)
    counts["yaw_rate"] = rng.integers(-9000, 9000, rows).astype(np.int16)
    counts["yaw_rate"][rows // 2 :] //= 64
    lost = (np.arange(rows) % every != 0) | (rng.random(rows) < 0.1)
    counts["course"] = pa.array(counts["course"], mask=lost)
    counts["ay"] = pa.array(counts["ay"], mask=rng.random(rows) < 0.05)
    counts["yaw_rate"] = pa.array(counts["yaw_rate"], mask=rng.random(rows) < 0.3 / rows)
    counts[LABEL] = pa.nulls(rows, pa.int16())
    table = log_rows(name, counts)
    ticks = np.arange(rows) + np.where(np.arange(rows) > rows * 2 // 3, 300, 0)
    at = table.schema.get_field_index("tick")
    return table.set_column(at, "tick", pa.array(ticks.astype(np.int32)))


def nearest(value: Fraction) -> int:
    return int(math.copysign(math.floor(abs(value) + Fraction(1, 2)), value))


def plain_changes(table: pa.Table, late: int = 0) -> dict[int, tuple[int, ...]]:
    """Tick of each change, and its last four columns, in words of plain Python."""
    rows = {row["tick"]: row for row in table.to_pylist()}
    units, found = course_units(), dict[int, tuple[int, ...]]()
    whole = math.floor(Fraction(late, 4) + Fraction(1, 2))
    for tick in rows:
        now, before = (rows.get(t + whole, {}).get("course") for t in (tick, tick - APART))
        between = [rows.get(t, {}).get("yaw_rate") for t in range(tick - APART, tick + 1)]
        if None in (now, before, *between):
            continue
        turned = between[0] + between[-1] + 2 * sum(between[1:-1])
        rest = Fraction(late, 4) - whole  # of a tick, which is two counts of what is turned
        angle = Fraction(now - before, 65536) * units.turn - turned
        angle += 2 * rest * (between[-1] - between[0])
        angle -= units.turn * nearest(angle / units.turn)
        if abs(angle) * Fraction(1, 2_000_000) <= LARGEST_RAD:
            change = nearest(angle / 200)
            slow = max(abs(between[0]), abs(between[-1])) <= 200 and abs(turned) <= 100_000
            found[tick] = (nearest(Fraction(turned, 256)), slow, slow * change, change)
    return found


@pytest.mark.parametrize(
    "late", [0, -11, 34, *(pytest.param(n, marks=pytest.mark.long) for n in (-40, -2, 1, 3, 80))]
)
def test_the_changes_of_a_hostile_drive_are_those_of_plain_integers(late: int) -> None:
    table = hostile_drive("a", 6000, 7)
    plan = ColumnPlan.of_set(features(), "course")
    workspace, counts = Workspace(plan), counts_of(table, plan, {})
    workspace.load(counts)
    found = course_changes(find_fixes(workspace, counts, late), APART)
    expected = plain_changes(table, late)
    assert len(expected) > 40
    assert counts.ticks[found.rows].tolist() == [0, *expected]
    assert np.isnan(found.columns[:, 0]).all()
    changes = found.columns[-4:, 1:].astype(int).tolist()
    assert list(zip(*changes, strict=True)) == list(expected.values())
    assert 0 < sum(slow for _, slow, _, _ in expected.values()) < len(expected)


@pytest.mark.parametrize(
    ("name", "late"),
    [
        ("course", None),
        pytest.param("course", {"car-1": -11}, marks=pytest.mark.long),
        ("three", {"car-1": 34, "other": 1}),
    ],
)
def test_gram_rows_of_the_kernel_are_those_of_the_statement(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch, name: str, late: dict[str, int] | None
) -> None:
    """Also of several times, and with what a car knows of itself."""
    gated = features().members("cornering")[0]
    windows = ("ay_mean_16", "ay_mean_16_mass", gated, "course_sum_16", "ay_bias")
    few = FeatureSet(description="few", signals=("ax", "ay"), windows=windows)
    three = FeatureSet(
        description="three", of="few", change_s=(Decimal("3.5"), Decimal(4), Decimal(5))
    )
    monkeypatch.setitem(features().sets, "few", few)
    monkeypatch.setitem(features().sets, "three", three)
    assert features().feature_set("three").windows == windows[:3]
    land(warehouse, "one", hostile_drive("b", 4000, 1), hostile_drive("a", 300, 2))
    land(warehouse, "two", hostile_drive("c", 9000, 3), hostile_drive("d", 2500, 4, every=1))
    files = warehouse.logs.snapshot().files
    kernel = wide_grams(warehouse, files, name, late)
    defined = by_sql(warehouse, files, name, late).cast(kernel.schema)
    changed = kernel.filter(pc.match_substring(kernel["signals"], TURNED))
    assert set(changed["drive_id"].to_pylist()) == {"b", "c", "d"}
    assert {"ay", TURNED, LABEL} <= set(changed["signals"][0].as_py().split(","))
    assert grams_of(kernel) == grams_of(defined)
    for column in kernel.column_names:
        assert kernel[column].to_pylist() == defined[column].to_pylist(), column
    parts = {"course": {None}, "three": {"3.5 s", "4 s", "5 s"}}
    assert set(changed["part"].to_pylist()) == parts[name]
    assert aggregate(warehouse, files, feature_set=name, late=late).equals(kernel)
    assert set(kernel["course_late"].to_pylist()) == {(late or {}).get("car-1")}


def test_a_log_without_a_course_has_no_changes(warehouse: Warehouse) -> None:
    table = hostile_drive("a", 1000, 1)
    land(warehouse, "one", table.drop_columns(["course", "satellite_speed"]))
    files = warehouse.logs.snapshot().files
    for rows in (wide_grams(warehouse, files, "course"), by_sql(warehouse, files, "course")):
        assert (rows["n"].to_pylist(), rows["signals"].to_pylist()) == ([1], [""])


def test_the_label_is_the_change_of_the_side_slip_angle() -> None:
    """Round several turns, with the course's and the yaw rate's grain as the only errors."""
    time = np.arange(5000) / 100
    slip, r = 0.05 * np.sin(1.3 * time), 0.6 + 0.3 * np.sin(0.5 * time)
    heading = 0.6 * time - 0.6 * np.cos(0.5 * time)
    course = np.rint((heading + slip) * 65536 / (2 * np.pi)).astype(np.int64)
    counts: dict[str, Any] = {name: np.zeros(5000, np.int16) for name in catalogue().inputs}
    counts["course"] = pa.array(
        ((course + 32768) % 65536 - 32768).astype(np.int16), mask=np.arange(5000) % 10 != 0
    )
    counts["yaw_rate"] = np.rint(r * 10_000).astype(np.int16)
    plan = ColumnPlan.of_set(features(), "course")
    workspace, loaded = Workspace(plan), counts_of(log_rows("a", counts), plan, {})
    workspace.load(loaded)
    found = course_changes(find_fixes(workspace, loaded), APART)
    rows, columns = found.rows[1:], found.columns[:, 1:]
    assert len(rows) == 460
    changed = slip[rows] - slip[rows - APART]
    assert np.abs(columns[-1] * 1e-4 - changed).max() < 3e-4
    turned = heading[rows] - heading[rows - APART]
    assert np.abs(columns[-4] * 1.28e-4 - turned).max() < 2e-4


def test_a_turn_is_a_whole_number_of_integrated_counts() -> None:
    units = course_units()
    assert (units.turn, units.divisor) == (12_566_371, 13_107_200)
    assert units.turn * 0.5e-6 == pytest.approx(2 * math.pi, rel=4e-8)
