"""Columns over time by the kernel, by SQL and by plain integers: the same, on hostile drives."""

from fractions import Fraction
from math import floor
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.catalog.definitions import (
    LARGEST_BITS,
    WEIGHT,
    Definition,
    Gate,
    limit_of,
)
from fleet_slip.columns.column_sql import with_columns
from fleet_slip.columns.drive_columns import BLOCK_ROWS, ColumnPlan, DriveCounts, compute_columns
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.compute import aggregate, by_kernel, by_sql, gram_statement
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.verify import grams_of
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.warehouse import Warehouse
from tests.export.models import DEFINITIONS as OF_MODELS
from tests.export.models import SPEED
from tests.support.catalog import CATALOG, configs_with
from tests.support.counts import nearest
from tests.support.logs import land, log_rows, random_counts

OPEN_ABOVE = Gate(by=SPEED, low=500, peak=1501)
DEFINITIONS = {
    name: definition for name, definition in OF_MODELS.items() if definition.number is None
} | {"above": Definition(of="ay", over="mean", ticks=3, ratio=Fraction(16), gate=OPEN_ABOVE)}

COUNT = st.one_of(
    st.none(), st.sampled_from([-32768, -32767, -1, 0, 1, 32767]), st.integers(-2000, 2000)
)
SIGNALS = ("ax", "ay", "yaw_rate", "wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")


@st.composite
def drives(draw: st.DrawFn) -> pa.Table:
    """A drive with holes, missing values and extremes, perhaps of one row."""
    rows = draw(st.integers(1, 12))
    steps = draw(st.lists(st.sampled_from([1, 1, 1, 2, 5]), min_size=rows, max_size=rows))
    counts = {
        name: pa.array(draw(st.lists(COUNT, min_size=rows, max_size=rows)), pa.int16())
        for name in SIGNALS
    }
    mass = draw(st.sampled_from([None, 1320.0, 1320.5, 1999.4, 900.0, 1e9, float("nan")]))
    counts["tick"] = np.cumsum([0, *steps[1:]])
    return log_rows("d", counts, mass_kg=mass, vehicle_model=draw(st.sampled_from(["suv", "van"])))


def clip(value: int, bits: int) -> int:
    return max(-limit_of(bits), min(limit_of(bits), value))


def by_integers(rows: list[dict[str, Any]], definition: Definition) -> list[int | None]:
    """The rule of the windows, in words of plain Python."""
    values: list[int | None] = []
    for row in rows:
        now = looked_at(row, definition)
        if definition.over == "lag":
            past = [
                looked_at(r, definition)
                for r in rows
                if r["tick"] == row["tick"] - definition.ticks
            ]
            value = Fraction(past[0]) if past and past[0] is not None else None
        elif now is None:
            value = None
        elif definition.over is None:
            value = Fraction(now)
        else:
            first = row["tick"] - definition.ticks + 1 if definition.ticks else 0
            window = [looked_at(r, definition) for r in rows if first <= r["tick"] <= row["tick"]]
            present = [v for v in window if v is not None]
            value = Fraction(sum(present), 1 if definition.over == "sum" else len(present))
        count = None if value is None else clip(nearest(value * definition.ratio), definition.bits)
        if definition.fact and count is not None:
            number = fact(row, definition)
            times = None if number is None else nearest(count * number * definition.fact.ratio)
            count = None if times is None else clip(times, definition.bits)
        values.append(count)
    if definition.gate:
        openings = by_integers(rows, definition.gate.by)
        return [
            None
            if value is None or at is None
            else nearest(Fraction(value * weight(at, definition.gate), WEIGHT))
            for value, at in zip(values, openings, strict=True)
        ]
    return values


def weight(at: int, gate: Gate) -> int:
    if gate.low < at < gate.peak:
        return floor(Fraction(WEIGHT * (at - gate.low), gate.peak - gate.low))
    if at < gate.peak or (gate.high is not None and at >= gate.high):
        return 0
    if gate.high is None:
        return WEIGHT
    return WEIGHT - floor(Fraction(WEIGHT * (at - gate.peak), gate.high - gate.peak))


def fact(row: dict[str, Any], definition: Definition) -> int | None:
    assert definition.fact is not None
    if definition.fact.equals:
        return int(row["vehicle_model"] == definition.fact.equals)
    mass = row["mass_kg"]
    if mass is None or not abs(mass) <= 65536:
        return None
    return nearest(Fraction(mass)) - definition.fact.less


def looked_at(row: dict[str, Any], definition: Definition) -> int | None:
    if not definition.sql:
        count: int | None = row[definition.of]
        return count
    values = [row[name] for name in SIGNALS[1:]]
    if None in values:
        return None
    ay, yaw_rate, *wheels = values
    if 31 * sum(wheels) < 120_000:
        return None
    quotient = Fraction(4_000_000 * ay - 310 * yaw_rate * sum(wheels), 31 * sum(wheels))
    return clip(nearest(quotient), definition.of_bits)


def counts_of_table(table: pa.Table) -> DriveCounts:
    present = {n: table[n].is_valid().to_numpy(zero_copy_only=False) for n in SIGNALS}
    counts = {n: table[n].fill_null(0).to_numpy() for n in SIGNALS}
    facts = {name: table[name][0].as_py() for name in ("mass_kg", "vehicle_model")}
    return DriveCounts(table["tick"].to_numpy(), counts, present, facts)


@settings(max_examples=40)
@given(drives())
def test_kernel_sql_and_plain_integers_agree_on_hostile_drives(table: pa.Table) -> None:
    plan = ColumnPlan.from_definitions(list(DEFINITIONS), {}, DEFINITIONS)
    blocks = plan.blocks(counts_of_table(table))
    computed = [(block.copy(), clips.copy()) for _, block, clips in blocks]
    kernel, clipped = (np.concatenate(parts, axis=-1) for parts in zip(*computed, strict=True))
    with duckdb.connect() as database:
        database.register("log_counts", table.drop_columns(["day"]))
        rows = with_columns("log_counts", {}, DEFINITIONS)
        query = f"SELECT {', '.join(DEFINITIONS)}, clipped FROM {rows} ORDER BY tick"
        sql: pa.Table = database.sql(query).to_arrow_table()
    logged = table.to_pylist()
    for number, (name, definition) in enumerate(DEFINITIONS.items()):
        expected = by_integers(logged, definition)
        assert sql[name].to_pylist() == expected, name
        assert [None if np.isnan(v) else int(v) for v in kernel[number]] == expected, name
    assert sql["clipped"].to_pylist() == clipped.astype(int).tolist()


def test_a_whole_drive_takes_the_fast_loop_to_the_same_integers() -> None:
    """The loop for drives without holes, against the one for all drives."""
    rng = np.random.default_rng(5)
    counts = {n: rng.integers(-32768, 32768, 9000).astype(np.int16) for n in SIGNALS}
    counts["wheel_fl"][:] = 9000
    plan = ColumnPlan.from_definitions(list(DEFINITIONS), {}, DEFINITIONS)
    facts = {"mass_kg": 1400.0, "vehicle_model": "suv"}
    ticks = np.arange(9000)
    fast = compute_columns(plan, DriveCounts(ticks, counts, {}, facts))
    ticks = np.append(ticks[:-1], 9001)  # a hole before the last row alone
    slow = compute_columns(plan, DriveCounts(ticks, counts, {}, facts))
    np.testing.assert_array_equal(fast[:, :-1], slow[:, :-1])


def hostile_drive(name: str, rows: int, seed: int, *, null: float = 0.1) -> pa.Table:
    rng = np.random.default_rng(seed)
    counts: dict[str, Any] = random_counts(rng, rows)
    for wheel in ("fl", "fr", "rl", "rr"):
        counts[f"wheel_{wheel}"] = rng.integers(0, 12_000, rows).astype(np.int16)
    for signal in ("ay", "wheel_rl", "sideslip"):
        counts[signal] = pa.array(counts[signal], mask=rng.random(rows) < null)
    ticks = np.cumsum(rng.choice([1, 1, 1, 300], rows))
    return log_rows(name, {**counts, "tick": ticks - ticks[0]})


FEW = """
[sets.few]
description = "few"
signals = ["ax", "ay", "yaw_rate", "wheel_rl"]
features = ["curvature", "rear_ay"]
windows = ["ay_mean_16", "ay_bias", "yaw_rate_speed_mean_8"]
"""


def test_gram_rows_of_the_kernel_are_those_of_the_statement(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    feature_set = "few"
    warehouse = Warehouse(warehouse.root, configs_with(tmp_path / "configs", features=FEW))
    rows = log_rows("whole", random_counts(np.random.default_rng(3), 700))
    land(warehouse, "one", hostile_drive("b", 400, 1), hostile_drive("a", 2, 2).slice(0, 1), rows)
    land(warehouse, "two", hostile_drive("c", 5000, 4, null=0.001))
    files = warehouse.logs.snapshot().files
    kernel = by_kernel(warehouse, files, feature_set)
    defined = by_sql(warehouse, files, feature_set).cast(kernel.schema)
    assert kernel.num_rows > 8
    assert sum(kernel["n"].to_pylist()) == 6101
    assert len(grams_of(kernel)) == kernel.num_rows
    assert grams_of(kernel) == grams_of(defined)
    assert kernel.sort_by("drive_id").drop_columns(["sums", "products"]).num_rows
    for name in kernel.column_names:
        assert kernel[name].to_pylist() == defined[name].to_pylist(), name
    assert aggregate(warehouse, files, feature_set=feature_set).equals(kernel)


def test_blocks_of_time_divide_the_gram_row_of_a_whole_drive(warehouse: Warehouse) -> None:
    """Their columns are those of `windows`, and each row is in one of them."""
    land(warehouse, "one", hostile_drive("a", 5000, 4), hostile_drive("b", 40, 5))
    files = warehouse.logs.snapshot().files
    columns = ("ay_mean_16", "curvature_mean_64", "sideslip")
    sums = []
    for feature_set in ("blocks", "windows"):
        rows = by_kernel(warehouse, files, feature_set)
        totals = dict.fromkeys(("a", "b"), Gram.zero(columns))
        for (name, signals), gram in grams_of(rows).items():
            if set(columns) <= set(signals):
                totals[name[0]] += gram.restrict(columns)
        sums.append((sum(rows["n"].to_pylist()), totals))
        parts = set(rows["part"].to_pylist())
        blocks = {"block 0001", "block 0002", "block 0010"}
        assert parts >= blocks if feature_set == "blocks" else parts == {None}
    assert sums[0] == sums[1]
    assert sums[0][0] == 5040


@pytest.mark.parametrize("feature_set", ["windows", "gated", "course"])
def test_only_the_kernel_computes_large_and_divided_sets(feature_set: str) -> None:
    with pytest.raises(QuestionError, match="SQL cannot compute"):
        gram_statement(CATALOG, feature_set)


def test_a_drive_that_goes_back_in_time_is_refused(warehouse: Warehouse) -> None:
    counts = random_counts(np.random.default_rng(1), 4)
    land(warehouse, "one", log_rows("d", {**counts, "tick": [0, 1, 1, 2]}))
    with pytest.raises(DataError, match=r"drive d: .*ticks of a drive do not increase"):
        update_grams(warehouse, feature_set="windows")


def test_the_order_of_rows_in_a_file_does_not_matter(warehouse: Warehouse) -> None:
    table = pa.concat_tables([hostile_drive("a", 50, 1), hostile_drive("b", 50, 2)])
    land(warehouse, "sorted", table)
    (first,) = warehouse.logs.snapshot().files
    before = grams_of(by_kernel(warehouse, [first], "windows"))
    order = np.random.default_rng(0).permutation(100)
    land(warehouse, "mixed", table.take(pa.array(order)))
    other = next(f for f in warehouse.logs.snapshot().files if f.path != first.path)
    assert grams_of(by_kernel(warehouse, [other], "windows")) == before


def test_products_of_a_block_are_exact_in_binary64() -> None:
    assert BLOCK_ROWS * (2 * limit_of(LARGEST_BITS)) ** 2 < 2**53, "changes are twice as large"
