"""Features against their physical definitions, and kinds of Gram rows against plain integers."""

import re
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.catalog import load_catalog
from fleet_slip.catalog.definitions import (
    CALIBRATION_PARAMETERS,
    EXCHANGED,
    OFFSETS,
    OPPOSITE,
    WEIGHT,
    Definition,
    Gate,
    limit_of,
    parity,
)
from fleet_slip.catalog.features import FeatureFile
from fleet_slip.columns.column_sql import with_columns
from fleet_slip.columns.drive_columns import ColumnPlan, DriveCounts, compute_columns
from fleet_slip.config import load_config
from fleet_slip.errors import ConfigError, DataError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.models.request import load_model_list
from fleet_slip.quality.course_relation import CourseRelation, relate
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.resources import folder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS, configs_with
from tests.support.counts import nearest
from tests.support.logs import land, log_rows, random_counts

RADIUS_M = Fraction(31, 100)
TRACK_M = Fraction(155, 100)
INPUTS = SIGNALS.inputs
LABEL = SIGNALS.label

Row = dict[str, Fraction]


def speed(row: Row) -> Fraction:
    wheels = [row[f"wheel_{corner}"] for corner in ("fl", "fr", "rl", "rr")]
    return RADIUS_M * sum(wheels, Fraction(0)) / 4


def over_speed(name: str) -> Callable[[Row], Fraction | None]:
    # The shipped guard is 120,000 / (31 * 4 * 40 ...) counts: 3 m/s, to within one count.
    return lambda row: row[name] / speed(row) if speed(row) >= 3 else None


def rear_turn(row: Row) -> Fraction:
    """Yaw rate of the rear axle, if its wheels roll: their difference of speed over the track."""
    return RADIUS_M * (row["wheel_rr"] - row["wheel_rl"]) / TRACK_M


def rear_curvature(row: Row) -> Fraction:
    return rear_turn(row) / rear_speed(row)


def excess(row: Row) -> Fraction:
    """Steering beyond Ackermann's angle, which is the wheelbase of 2.78 m times the curvature."""
    steering = (row["steer_fl"] + row["steer_fr"]) / 2
    side = (row["ay"] > 0) - (row["ay"] < 0)
    return (steering - Fraction(278, 100) * rear_curvature(row)) * side


def rear_speed(row: Row) -> Fraction:
    return RADIUS_M * (row["wheel_rl"] + row["wheel_rr"]) / 2


def steering_surplus(row: Row) -> Fraction | None:
    """2.63 m and K of the file in the whole numbers that stand for them; squares are truncated."""
    ay = 1000 * abs(row["ay"])
    load = 1 + Fraction(ay * ay // 100, 10_000)
    wheels = row["wheel_rl"] + row["wheel_rr"]
    if wheels * load < Fraction("19.35"):
        return None
    wheelbase = Fraction(16_967_742, 5_000_000)
    steer = (row["steer_fl"] + row["steer_fr"]) / 2
    straight = steer - wheelbase * (row["wheel_rr"] - row["wheel_rl"]) / wheels
    beyond = 5000 * row["ay"] * straight - Fraction(14 * ay * ay, 10**6)
    beyond -= Fraction(ay * (ay * ay // 65536) ** 2 // 9, 10**6)
    coasting = int(row["ax"] > Fraction("-0.5")) + int(row["ax"] >= Fraction("-0.5"))
    return coasting * beyond / load / 10_000


PHYSICS: dict[str, Callable[[Row], Fraction | None]] = {
    "speed": speed,
    "speed_squared": lambda row: speed(row) ** 2,
    "yaw_rate_speed": lambda row: row["yaw_rate"] * speed(row),
    "curvature": over_speed("yaw_rate"),
    "course_rate": over_speed("ay"),
    "slowness": lambda row: 1 / speed(row) if speed(row) >= 3 else None,
    "ay_signed_square": lambda row: row["ay"] * abs(row["ay"]),
    "ay_cube": lambda row: row["ay"] ** 3,
    "yaw_rate_signed_square": lambda row: row["yaw_rate"] * abs(row["yaw_rate"]),
    "steer_mean": lambda row: (row["steer_fl"] + row["steer_fr"]) / 2,
    "steer_speed_squared": lambda row: (row["steer_fl"] + row["steer_fr"]) / 2 * speed(row) ** 2,
    "course_difference": lambda row: (
        row["ay"] / speed(row) - row["yaw_rate"] if speed(row) >= 3 else None
    ),
    "yaw_rate_excess": lambda row: (
        row["yaw_rate"] - (row["wheel_rr"] - row["wheel_rl"]) * RADIUS_M / TRACK_M
    ),
    "ay_excess": lambda row: row["ay"] - row["yaw_rate"] * speed(row),
    "curvature_fine": over_speed("yaw_rate"),
    "ay_speed": lambda row: row["ay"] * speed(row),
    "ay_ax": lambda row: row["ay"] * row["ax"],
    "steering_excess": lambda row: excess(row) if rear_speed(row) >= 3 else None,
    "steering_surplus": steering_surplus,
    "ay_size": lambda row: abs(row["ay"]),
    "rear_curvature": lambda row: rear_curvature(row) if rear_speed(row) >= 3 else None,
    "rear_ay": lambda row: rear_turn(row) * rear_speed(row),
    "rear_ay_speed": lambda row: rear_turn(row) * rear_speed(row) ** 2,
    "rear_ay_ax": lambda row: rear_turn(row) * rear_speed(row) * row["ax"],
    "rear_speed": lambda row: rear_speed(row) * Fraction(102, 100),
    "rear_path": lambda row: rear_speed(row) * Fraction(102, 10000),
    "rear_turn": lambda row: row["yaw_rate"] * rear_speed(row) * Fraction(102, 10000),
    "lateral_gain": lambda row: (
        row["ay"] / 100 - row["yaw_rate"] * rear_speed(row) * Fraction(102, 10000)
    ),
    "wheel_difference_front": lambda row: row["wheel_fr"] - row["wheel_fl"],
    "wheel_difference_rear": lambda row: row["wheel_rr"] - row["wheel_rl"],
    "wheel_difference_axles": lambda row: (
        (row["wheel_rl"] + row["wheel_rr"] - row["wheel_fl"] - row["wheel_fr"]) / 2
    ),
}


def counts(rows: int, seed: int) -> dict[str, Any]:
    return random_counts(np.random.default_rng(seed), rows)


def computed_by_kernel(logged: dict[str, Any]) -> dict[str, list[float | None]]:
    features = CATALOG.features
    rows = CATALOG.rows(features)
    drive = DriveCounts(np.arange(len(logged["ay"])), {name: logged[name] for name in INPUTS})
    columns = compute_columns(ColumnPlan.from_definitions(tuple(features), rows, {}), drive)
    return {
        name: [None if np.isnan(value) else value for value in column]
        for name, column in zip(features, columns, strict=True)
    }


def test_every_feature_is_its_physical_definition_rounded_and_clipped() -> None:
    logged = counts(400, 7)
    # Ordinary driving too, where the guarded quotients exist and nothing is clipped.
    for name in INPUTS:
        logged[name][200:] = (logged[name][200:] // 40) + (1500 if "wheel" in name else 0)
    definitions = CATALOG.rows(CATALOG.features)
    assert set(definitions) == set(PHYSICS)
    with duckdb.connect() as database:
        database.register("log_counts", pa.table(logged))
        query = f"SELECT * FROM {with_columns('log_counts', definitions, {})}"
        table: pa.Table = database.sql(query).to_arrow_table()
    by_kernel = computed_by_kernel(logged)
    for name in definitions:
        np.testing.assert_array_equal(by_kernel[name], table[name].to_pylist(), err_msg=name)
    exact = {name: SIGNALS[name].exact_scale for name in INPUTS}
    clipped = 0
    for i, row in enumerate(table.to_pylist()):
        physical = {name: int(logged[name][i]) * exact[name] for name in INPUTS}
        out_of_range = 0
        for name, formula in PHYSICS.items():
            value = formula(physical)
            if value is None:
                assert row[name] is None
                continue
            count = nearest(value / CATALOG.features[name].exact_scale)
            limit = limit_of(CATALOG.features[name].bits)
            out_of_range += abs(count) > limit
            assert row[name] == max(-limit, min(limit, count)), (name, i)
        assert row["clipped"] == out_of_range
        clipped += out_of_range
    assert clipped > 100
    assert table["curvature"].null_count > 50
    assert len(table) - table["curvature"].null_count > 50


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('counts = "ay * abs(ay)"', 'counts = "ay * sideslip"', "sideslip: not an input signal"),
        ('counts = "ay * abs(ay)"', 'counts = "ay * vx"', "vx: not an input signal"),
        ('counts = "ay * abs(ay)"', 'counts = "ay / 2.5"', "not integer arithmetic"),
        ('counts = "ay * abs(ay)"', 'counts = "ay) FROM x; DROP TABLE y; --"', "not integer"),
        ('counts = "ay * abs(ay)"', 'counts = "ay ** 2"', "not integer arithmetic"),
        ('counts = "ay * abs(ay)"', 'counts = "ay -- 3"', "not integer arithmetic"),
        ('counts = "ay * abs(ay)"', 'counts = "5"', "is of no signal"),
        ('counts = "ay * abs(ay)"', 'counts = "ay*ay*ay*ay*ay"', "more than 64 bits"),
        ("at_least = 120000\n", "", "at_least is for a divisor that varies"),
        ('column = "speed_mps"', 'column = "ay_mps2"', "names must differ"),
        ('divided_by = "50000"', 'divided_by = "0"', "divided_by is zero"),
        ("block_s = 60", "block_s = 0.005", "block_s must be a multiple of 0.01"),
        ("change_s = 4\n", 'change_s = 4\ncalibrated = ["none"]\n', "unknown none"),
    ],
)
def test_a_feature_that_is_not_integer_arithmetic_on_inputs_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    text = (folder("configs") / "features.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "features.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_config(tmp_path / "features.toml", FeatureFile, SIGNALS)


def cohort_gram(warehouse: Warehouse, feature_set: str, signals: list[str]) -> Gram:
    table: GramTable = (
        load_cohort(warehouse, "true", feature_set).complete_cases(signals[:-1]).table
    )
    assert table.signals == tuple(signals)
    return table.total()


def drive(name: str, rows: int, seed: int, **changed: Any) -> pa.Table:
    """A drive at speeds up to 30 m/s, so that most rows have every feature."""
    logged = counts(rows, seed)
    rng = np.random.default_rng(seed)
    for wheel in ("fl", "fr", "rl", "rr"):
        logged[f"wheel_{wheel}"] = rng.integers(0, 10_000, rows).astype(np.int16)
    logged["ay"] = rng.integers(-6000, 6000, rows).astype(np.int16)
    return log_rows(name, logged | changed)


def test_a_set_costs_one_pass_and_stands_beside_the_others(warehouse: Warehouse) -> None:
    land(warehouse, "one", drive("a", 300, 1), drive("b", 200, 2))
    plain = update_grams(warehouse)
    motion = update_grams(warehouse, feature_set="motion")
    assert (plain.rows_read, motion.rows_read) == (500, 500)
    signals = [*INPUTS, LABEL]
    assert cohort_gram(warehouse, "motion", signals) == cohort_gram(warehouse, "signals", signals)
    with_curvature = load_cohort(warehouse, "true", "motion").complete_cases(["ay", "curvature"])
    assert 0 < with_curvature.table.total().n < 500
    assert with_curvature.drives.num_rows == 2
    land(warehouse, "two", drive("c", 100, 3))
    update_grams(warehouse)
    with pytest.raises(DataError, match="missing for 1 log files"):
        load_cohort(warehouse, "true", "motion")
    assert update_grams(warehouse, feature_set="motion").rows_read == 100


def test_a_changed_definition_never_mixes_with_the_old_rows(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    land(warehouse, "one", drive("a", 300, 1))
    update_grams(warehouse, feature_set="motion")
    before = CATALOG
    text = (folder("configs") / "features.toml").read_text(encoding="utf-8")
    changed_text = text.replace("at_least = 120000", "at_least = 400000")
    configs = configs_with(tmp_path / "configs", features=changed_text)
    changed = load_catalog(configs)
    assert changed.identity("motion") != before.identity("motion")
    assert changed.identity("delay") == before.identity("delay")
    now = Warehouse(warehouse.root, configs)
    assert update_grams(now, feature_set="motion").rows_read == 300
    paths = warehouse.grams.snapshot().paths
    rows = pl.concat(pl.read_parquet(path) for path in paths).filter(
        pl.col("signals").str.contains("curvature")
    )
    with_curvature = dict(rows.group_by("feature_set").agg(pl.col("n").sum()).iter_rows())
    old, new = (with_curvature[catalog.identity("motion")] for catalog in (before, changed))
    assert 0 < new < old < 300


def test_a_drive_with_several_gram_rows_is_one_drive(warehouse: Warehouse) -> None:
    standing = np.zeros(300, dtype=np.int16)
    wheels = {f"wheel_{w}": np.r_[standing[:100], [8000] * 200] for w in ("fl", "fr", "rl", "rr")}
    land(warehouse, "one", drive("a", 300, 8, **wheels), drive("b", 300, 9))
    update_grams(warehouse, feature_set="motion")
    cohort = load_cohort(warehouse, "true", "motion")
    assert len(cohort.drives) > 2
    assert cohort.drive_count == 2
    served = cohort.complete_cases(["ay", "yaw_rate"])
    assert served.drives["drive_id"].to_pylist() == ["a", "b"]
    assert served.table.n.tolist() == [300, 300]
    moving = cohort.complete_cases(["ay", "curvature"])
    assert int(moving.table.n[moving.drives["drive_id"].to_pylist().index("a")]) == 200


def test_a_gate_that_an_odd_column_opens_makes_a_column_of_neither_kind() -> None:
    column = CATALOG.time_columns["ay_mean_16_cornering_1"].definition
    assert column.gate is not None
    by_ay = column.gate.model_copy(update={"by": CATALOG.time_columns["ay_mean_32"].definition})
    assert parity(column) == -1 and parity(column.model_copy(update={"gate": by_ay})) == 0


@pytest.mark.parametrize("name", ["windows", "course_gated", "fleet"])
def test_odd_columns_are_opposite_in_a_mirrored_drive(name: str) -> None:
    """By the kernel that Gram rows come from, every column of the set; no other one is odd."""
    catalog = CATALOG
    names = catalog.feature_set(name).inputs
    random = np.random.default_rng(1)
    drive = {name: random.integers(4000, 6000, 400) for name in SIGNALS.inputs}
    drive |= {name: random.integers(-3000, 3000, 400) for name in drive if name in OPPOSITE}
    other = {
        name: -drive[name] if name in OPPOSITE else drive[EXCHANGED.get(name, name)]
        for name in drive
    }
    windows = {
        name: catalog.time_columns[name].definition
        for name in names
        if name in catalog.time_columns
    }
    plan = ColumnPlan.from_definitions(names, catalog.rows(names), windows)

    def columns(counts: dict[str, np.ndarray], offset: int) -> np.ndarray:
        numbers: dict[str, int] = {
            name: offset if name in OFFSETS else 500 for name in CALIBRATION_PARAMETERS
        }
        counts_of_rows = {name: values.astype(np.int16) for name, values in counts.items()}
        facts = {"mass_kg": 1400.0, "vehicle_model": "suv"}
        return compute_columns(
            plan, DriveCounts(np.arange(400), counts_of_rows, numbers=numbers, facts=facts)
        )

    odd_names = [
        (name, np.array_equal(original, -mirrored, equal_nan=True))
        for name, original, mirrored in zip(
            names, columns(drive, 300), columns(other, -300), strict=True
        )
        if np.nan_to_num(original).any()  # a gate that stays closed has no sign
    ]
    assert 10 < sum(is_opposite for _, is_opposite in odd_names) < len(odd_names)
    assert odd_names == [(name, catalog.is_odd(name)) for name, _ in odd_names]


def test_a_search_among_changes_knows_odd_and_short_columns_alone() -> None:
    inputs = CATALOG.search_inputs("course")
    assert "ax" not in inputs and "wheel_fl" not in inputs and "curvature" not in inputs
    assert "ay_mean_128" in inputs and "ay_mean_256" not in inputs
    assert CATALOG.search_inputs("windows") == CATALOG.feature_set("windows").inputs


BY = Definition(of="ay")

knots = st.lists(st.integers(-2000, 2000), min_size=2, max_size=6, unique=True).map(sorted)


def family(edges: list[int]) -> list[Gate]:
    return [
        Gate(
            by=BY,
            low=edges[k - 1],
            peak=edges[k],
            high=edges[k + 1] if k + 1 < len(edges) else None,
        )
        for k in range(1, len(edges))
    ]


def columns_of(gates: list[Gate]) -> dict[str, Definition]:
    """A column for each gate that is its weight: what is gated is `WEIGHT` everywhere."""
    return {
        f"w{n}": Definition(of="full", sql=f"ay - ay + {WEIGHT}", gate=gate)
        for n, gate in enumerate(gates)
    }


def weights(gates: list[Gate], at: list[int]) -> FloatArray:
    """Weights by the kernel, shape (gates, counts)."""
    columns = columns_of(gates)
    drive = DriveCounts(np.arange(len(at)), {"ay": np.array(at, dtype=np.int16)})
    return compute_columns(ColumnPlan.from_definitions(list(columns), {}, columns), drive)


@given(knots)
def test_weights_add_up_to_one_above_the_second_knot(edges: list[int]) -> None:
    at = list(range(edges[1], edges[-1] + 50, 7))
    total = weights(family(edges), at).sum(axis=0)
    assert total.tolist() == [WEIGHT] * len(at)


@given(knots)
def test_a_weight_changes_by_no_more_than_its_slope(edges: list[int]) -> None:
    """From count to count: at most WEIGHT over the distance of the knots, and a rounding."""
    steepest = WEIGHT / min(high - low for low, high in pairwise(edges)) + 1
    at = list(range(edges[0] - 3, edges[-1] + 4))
    assert np.abs(np.diff(weights(family(edges), at))).max() <= steepest


def test_members_have_the_scale_of_their_column_and_neighbours_share_a_knot() -> None:
    catalog = CATALOG
    first, second = (
        catalog.input("rear_ay_mean_16_excess_1"),
        catalog.input("rear_ay_mean_16_excess_2"),
    )
    assert first.exact_scale == second.exact_scale == catalog.input("rear_ay_mean_16").exact_scale
    gates = [
        catalog.time_columns[f"rear_ay_mean_16_excess_{k}"].definition.gate for k in (1, 2, 3, 4)
    ]
    assert [gate.high for gate in gates if gate][:3] == [gate.peak for gate in gates if gate][1:]
    assert gates[-1] is not None
    assert gates[-1].high is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('of = "ay_mean_16"\nknots = [1.0]\ncolumns = ["ay_mean_8"]', "knots"),
        ('of = "ay_mean_16"\nknots = [1.0, 0.5]\ncolumns = ["ay_mean_8"]', "must increase"),
        ('of = "ay_mean_16"\nknots = [0.0, 0.00001]\ncolumns = ["ay_mean_8"]', "must increase"),
        ('of = "ay_mean_16"\nknots = [0.0, 1e9]\ncolumns = ["ay_mean_8"]', "within the range"),
        ('of = "nothing"\nknots = [0.0, 1.0]\ncolumns = ["ay_mean_8"]', "nothing"),
        ('of = "ay_mean_16"\nknots = [0.0, 1.0]\ncolumns = ["ay"]', "ay: no column over time"),
        (
            'of = "ay_mean_16_mass"\nknots = [0.0, 1.0]\ncolumns = ["ay_mean_8"]',
            "have a gate or a factor",
        ),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, words: str) -> None:
    gates = f'[gates.mine]\n{text}\ndescription = "x"\n'
    with pytest.raises(ConfigError, match=words) as caught:
        load_catalog(configs_with(tmp_path / "configs", features=gates))
    assert "gates.mine" in str(caught.value)


def test_a_set_of_changes_of_itself_is_refused(tmp_path: Path) -> None:
    sets = '[sets.mine]\ndescription = "x"\nof = "mine"\nchange_s = 1\n'
    with pytest.raises(ConfigError, match="mine is itself a set of changes"):
        load_catalog(configs_with(tmp_path / "configs", features=sets))


def test_a_family_in_a_model_list_stands_for_its_members() -> None:
    models = {model.name: model.signals for model in load_model_list(CATALOG, "gated").model}
    gates = [name for name in models["all"] if name not in models["no gate"]]
    families = ("excess", "road", "cornering")
    assert gates == [name for family in families for name in CATALOG.members(family)]
    assert set().union(*(models[family] for family in families)) == set(models["all"])


WINDOW = 'of = "ay"\nover = "mean"\nticks = [5, 9]\ncolumn = "any_{ticks}"'
MEAN_SO_FAR = 'of = "ay"\nover = "running_mean"\ncolumn = "any_{ticks}"'
CIRCLE = (
    'of = ["ay", "other"]\ncolumn = "any"\n'
    '[products.other]\nof = ["any", "ay"]\nscale = 1\nunit = "1"\ncolumn = "other"\n'
    'description = "x"\n'
)
SLOPE = 'ridge = [1]\ncolumn = "any"\nequations = [{ y = { ay_mean_8 = 1 }, of = "ay_mean_16", '


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        ("windows", WINDOW.replace("[5, 9]", "[5]").replace("_{ticks}", ""), "must contain {ticks"),
        ("windows", MEAN_SO_FAR, "must contain {ticks} if there are ticks, and only then"),
        ("windows", WINDOW.replace("9", "5"), "any_5 appears twice"),
        ("windows", WINDOW.replace("mean", "running_mean"), "ticks is for mean"),
        (
            "products",
            'of = ["ay", "any"]\ncolumn = "any"',
            "toml: products.any: it is made of itself",
        ),
        ("products", CIRCLE, "toml: products.any: products.other: it is made of itself"),
        ("slopes", SLOPE + "weight = 0 }]", "weight: must be greater than 0"),
        ("slopes", SLOPE + "weight = 1.5 }]", "weight: must be less than or equal to 1"),
    ],
)
def test_faults_of_columns_over_time_are_named(
    tmp_path: Path, kind: str, text: str, words: str
) -> None:
    entry = f'[{kind}.any]\nscale = 0.001\nunit = "1"\ndescription = "x"\n{text}\n'
    with pytest.raises(ConfigError, match=re.escape(words)):
        load_catalog(configs_with(tmp_path / "configs", features=entry))


Rows = NDArray[np.float64]
LEVER_M, COMPLIANCE, SPEED = 1.4, -0.005, 18.0
NOISE_MPS = 0.05


def changes(scale: float = 1.0, slip: float = 1.0, rows: int = 2000) -> Rows:
    """Return columns 1, curvature, ay, yaw rate, turned, label of a car at changing speeds."""
    rng = np.random.default_rng(7)
    curvature = 0.01 * rng.standard_normal(rows)
    speed = SPEED + 4 * rng.standard_normal(rows)
    yaw_rate, turned = curvature * speed, 0.5 * rng.standard_normal(rows)
    ay = yaw_rate * speed
    label = slip * (LEVER_M * curvature + COMPLIANCE * ay) + (scale - 1) * turned + 0.01
    label += np.sqrt(2) * NOISE_MPS / SPEED * rng.standard_normal(rows)
    return np.stack([np.ones(rows), curvature, ay, yaw_rate, turned, label])


def related(rows: Rows, delay_s: float = 0.0) -> CourseRelation:
    relation = relate(rows @ rows.T, delay_s)
    assert relation is not None
    return relation


def test_a_car_is_found_as_it_is() -> None:
    relation = related(changes(scale=1.02))
    assert relation.scale == pytest.approx(1.02, abs=2e-3)
    assert relation.lever_m == pytest.approx(LEVER_M, abs=0.1)
    assert relation.compliance == pytest.approx(COMPLIANCE, abs=3e-4)
    assert relation.noise_mps == pytest.approx(NOISE_MPS, rel=0.1)
    assert relation.fault is None and relation.misplaced is None


@pytest.mark.parametrize("shift", [-1.5, 1.6])
def test_another_place_has_another_lever(shift: float) -> None:
    rows = changes()
    rows[5] += shift * rows[1]
    relation = related(rows)
    assert relation.fault is None and relation.misplaced is not None
    assert "antenna" in relation.misplaced.remedy


def test_a_delay_that_is_known_is_no_other_place() -> None:
    rows = changes()
    rows[5] -= 0.1 * rows[3]
    assert related(rows).misplaced is not None
    assert related(rows, 0.1).misplaced is None
    assert related(rows, 0.1).lever_m == pytest.approx(LEVER_M, abs=0.1)


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (lambda rows: rows[5] - 2 * rows[4], "reversed"),
        (lambda rows: rows[5] - rows[4], "stuck"),
        (lambda rows: rows[5] + 0.15 * rows[4], "scaled"),
        (lambda rows: np.roll(rows[5], 7) * 8, "noisy"),
        (lambda _: changes(slip=0.0)[5], "no slip"),
    ],
)
def test_a_column_that_is_no_course_is_named(spoil: Callable[[Rows], Rows], kind: str) -> None:
    rows = changes()
    rows[5] = spoil(rows)
    fault = related(rows).fault
    assert fault is not None and fault.kind == kind


def test_little_driving_tells_nothing() -> None:
    short_drive = changes(rows=90)
    assert relate(short_drive @ short_drive.T) is None
    straight = changes()
    straight[4] *= 1e-3
    assert relate(straight @ straight.T) is None
