"""Calibrated columns follow from Gram rows and a number of each car, to the bits of the rows."""

from datetime import date
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.calibration.car_calibration import calibrate
from fleet_slip.catalog.definitions import CALIBRATION_PARAMETERS
from fleet_slip.columns.drive_columns import ColumnPlan, DriveCounts, compute_columns
from fleet_slip.errors import DataError, InputError
from fleet_slip.grams.calibrated_columns import expand
from fleet_slip.grams.cohort import Folding, load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.models.predict import predict
from fleet_slip.models.score import score
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support import cars
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.counts import table_of
from tests.support.logs import land, log_rows

DAY = date(2024, 5, 1)
WANTED: tuple[str, ...] = (
    "ay_mean_16",
    "slowness",
    "yaw_rate",
    "ay_offset_alone",
    "ay_offset_slowness",
    "understeer_ay",
    "wheelbase_alone",
    "yaw_rate_offset_slowness",
)


@pytest.mark.parametrize("factor", [7, 2**15 - 1])
def test_expanded_sums_are_those_of_the_rows(factor: int) -> None:
    rng = np.random.default_rng(1)
    grams, expected = [], []
    factors = rng.integers(-factor, factor + 1, (3, 3))
    for drive_factors in factors:
        counts = rng.integers(-(2**19), 2**19, (40, 3))
        new = [
            drive_factors[0] * counts[:, 1],
            drive_factors[1] * np.ones(40, dtype=np.int64),
            drive_factors[2] * counts[:, 0],
        ]
        both = np.column_stack([counts, *new])
        grams.append(Gram.from_counts(("a", "b", "c"), counts))
        expected.append(Gram.from_counts(("a", "b", "c", "bx", "x", "ax"), both.astype(object)))
    expanded = expand(table_of(grams), ("bx", "x", "ax"), [2, 0, 1], factors)
    assert [expanded.row(i) for i in range(3)] == expected
    assert expanded.total() == sum(expected[1:], expected[0])
    assert expanded.totals(np.array([0, 1, 0]), 2) == [expected[0] + expected[2], expected[1]]
    # Products of the larger factors need more than 64 bits.
    assert (expanded.products.dtype == object) == (factor > 7)


def offset(signals: cars.Signals, yaw_rate: float, ay: float) -> None:
    signals["yaw_rate"] += yaw_rate
    signals["ay"] += ay


def drive(rng: np.random.Generator, car: int) -> dict[str, Any]:
    broken = cars.broken(
        cars.drive(rng, 1.5), lambda signals: offset(signals, 0.01 * (car - 1), 0.1 * (2 - car))
    )
    return cars.counts({name: values[:1200] for name, values in broken.items()})


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Warehouse:
    """Four cars of two drives, with Gram rows of the sets fleet and calibration."""
    warehouse = fleet_slip.open(tmp_path_factory.mktemp("fleet")).warehouse
    rng = np.random.default_rng(2)
    for car in range(4):
        drives = [
            log_rows(f"car-{car}-{n}", drive(rng, car), DAY, vehicle_id=f"car-{car}")
            for n in range(2)
        ]
        land(warehouse, f"f{car}", *drives)
    update_grams(warehouse)
    update_grams(warehouse, feature_set="fleet")
    with pytest.raises(DataError, match="gram --features calibration"):
        load_cohort(warehouse, "true", "fleet")
    update_grams(warehouse, feature_set="calibration")
    return warehouse


def counts_of_drive(warehouse: Warehouse, drive_id: str, numbers: dict[str, int]) -> DriveCounts:
    plan = plan_of(WANTED)
    rows = fleet_slip.open(warehouse.root).sql(
        f"SELECT tick, {', '.join(plan.signals)} FROM log_counts WHERE drive_id = '{drive_id}' "
        "ORDER BY tick"
    )
    columns = {name: np.array(values) for name, values in rows.fetchnumpy().items()}
    return DriveCounts(columns.pop("tick"), columns, numbers=numbers)


def plan_of(names: tuple[str, ...]) -> ColumnPlan:
    catalog = CATALOG
    definitions = {
        name: definition for name in names if (definition := catalog.definition(name)) is not None
    }
    return ColumnPlan.from_definitions(names, ColumnPlan.of_set(catalog, "fleet").rows, definitions)


def test_gram_rows_have_the_bits_of_the_rows(filled: Warehouse) -> None:
    cohort = load_cohort(filled, "true", "fleet")
    (table,) = cohort.tables
    lacking = set(CATALOG.feature_set("fleet").inputs) - set(table.signals)
    numbers_lacking = {CATALOG.calibrated[name].number for name in lacking}
    assert numbers_lacking == {"slip_lever", "slip_compliance"}  # no car has a receiver
    numbers = calibrate(filled).counts()
    for at, row in enumerate(cohort.drives.to_pylist()):
        constants = numbers[row["vehicle_id"]]
        assert constants["ay_offset"] != 0
        columns = compute_columns(
            plan_of(WANTED), counts_of_drive(filled, row["drive_id"], constants)
        )
        assert not np.isnan(columns).any()
        by_rows = Gram.from_counts(WANTED, columns.T.astype(np.int64).astype(object))
        assert table.restrict(WANTED).row(at) == by_rows


def test_sums_over_folds_are_those_of_the_drives(filled: Warehouse) -> None:
    summed = load_cohort(filled, "true", "fleet", Folding(by="vehicle", count=10))
    total = load_cohort(filled, "true", "fleet").tables[0].total()
    sums = summed.folds("vehicle", 10).complete_cases(WANTED[:-1], WANTED[-1]).total
    assert sums == total.restrict(WANTED)
    assert "understeer_ay" not in summed.gram_condition(["understeer_ay"])
    assert "ay_mean_16" in summed.gram_condition(["understeer_ay"])


def test_a_new_car_takes_running_means_and_is_usual(filled: Warehouse) -> None:
    names = ("slowness", "yaw_rate_bias", "yaw_rate_offset_slowness", "understeer_ay")
    rows = compute_columns(plan_of(names), counts_of_drive(filled, "car-0-0", {}))
    np.testing.assert_array_equal(rows[2], rows[0] * rows[1])
    assert not rows[3].any()
    usual = CATALOG.time_columns["understeer_ay"].definition.number
    assert usual is not None
    assert usual.less * float(CALIBRATION_PARAMETERS["understeer"].grain) == pytest.approx(0.003)


def test_a_model_is_published_scored_and_asked(filled: Warehouse) -> None:
    fleet = fleet_slip.open(filled.root)
    chosen = fleet.cohort("true").select(
        order="ay_mean_16,curvature_mean_16,ay_offset_alone,understeer_ay", features="fleet"
    )
    version = fleet.models.publish("calibrated", chosen, force=True).version
    manifest = version.manifest
    used = {
        definition.number.name for definition in manifest.definitions.values() if definition.number
    }
    assert used
    result = score(filled, manifest, "true")
    assert result.rows == 8 * 1200
    assert result.rmse_deg == pytest.approx(manifest.cross_validation.rmse_deg, rel=0.3)

    frame = fleet.sql("SELECT * FROM log ORDER BY drive_id, tick").to_arrow_table()
    with pytest.raises(InputError, match="fleet-slip calibrate --car"):
        predict(SIGNALS, manifest, frame)
    cars_of = calibrate(filled)
    for name in used:
        values = [cars_of.car(car)[name].value for car in frame["vehicle_id"].to_pylist()]
        frame = frame.append_column(name, [values])
    angle = predict(SIGNALS, manifest, frame).to_numpy()
    error = np.degrees(angle - frame["sideslip_rad"].to_numpy())
    assert float(np.sqrt(np.mean(error**2))) == pytest.approx(result.rmse_deg, rel=1e-12)
