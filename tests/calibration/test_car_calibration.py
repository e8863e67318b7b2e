"""The numbers that a car's drives tell: found as they were made, exactly, in any order."""

import random
from collections.abc import Sequence
from datetime import date
from fractions import Fraction
from math import hypot
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.calibration.car_calibration import (
    CalibratedParameter,
    CarEvidence,
    DriveSums,
    calibrate,
    collect_sums,
    estimate_roads,
)
from fleet_slip.calibration.sensor_relations import (
    EVEN,
    KINDS,
    NO_CAR,
    NO_COURSE,
    NO_RECEIVER,
    NO_TYRE,
    STRAIGHT,
    CarTerms,
    estimate_parameters,
    kinds_by_set,
)
from fleet_slip.catalog.course import TURNED, turned_scale
from fleet_slip.catalog.definitions import (
    BY_COURSE,
    BY_SATELLITE,
    CALIBRATION_PARAMETERS,
)
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.forget import forget
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.erasure_log import ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support import cars
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.commands import done_on
from tests.support.logs import land, log_rows

DAY = date(2024, 5, 1)
TRUE = {"yaw_rate_offset": 0.013, "ay_offset": -0.21, "steering_offset": 0.004}
NONE_OFF = dict.fromkeys(TRUE, 0.0)
COLUMNS = CATALOG.feature_set("calibration").columns[:-1]


def biased(rng: np.random.Generator, offsets: dict[str, float]) -> dict[str, Any]:
    """Return the counts of a drive of a car whose sensors are off."""

    def change(signals: cars.Signals) -> None:
        signals["yaw_rate"] += offsets["yaw_rate_offset"]
        signals["ay"] += offsets["ay_offset"]
        for side in ("steer_fl", "steer_fr"):
            signals[side] += offsets["steering_offset"]

    return cars.counts(cars.broken(cars.drive(rng, 1.5), change))


def matrix(counts: dict[str, Any]) -> Any:
    """Return the columns of the set as plain numpy computes them, shape (rows, columns)."""
    wide = {name: values.astype(np.int64) for name, values in counts.items()}
    wheels = sum(wide[f"wheel_{corner}"] for corner in ("fl", "fr", "rl", "rr"))
    speed = wheels * 0.01 * 0.31 / 4
    wide["curvature"] = np.rint(wide["yaw_rate"] * 1e-4 / speed / 1e-5).astype(np.int64)
    wide["course_rate"] = np.rint(wide["ay"] * 1e-3 / speed / 1e-4).astype(np.int64)
    wide["slowness"] = np.rint(1 / speed / 4e-5).astype(np.int64)
    return np.stack([wide[name] for name in COLUMNS], axis=1)[speed > 3]


def gram_row(car: str, number: int, counts: dict[str, Any]) -> dict[str, Any]:
    return row_of(COLUMNS, matrix(counts), f"{car}-{number:03d}", car)


def row_of(columns: Sequence[str], counts: Any, drive: str, car: str = "car") -> dict[str, Any]:
    """Return the Gram row of counts, shape (rows, columns)."""
    gram = Gram.from_counts(columns, counts.astype(np.int64))
    facts = {"vehicle_id": car, "day": DAY, "drive_id": drive, "signals": ",".join(columns)}
    return facts | {"n": gram.n, "sums": list(gram.sums), "products": list(gram.products)}


def evidence(rows: list[dict[str, Any]], size: int = 7) -> CarEvidence:
    batches = [pa.RecordBatch.from_pylist(rows[i : i + size]) for i in range(0, len(rows), size)]
    return CarEvidence(CATALOG, collect_sums(batches, KINDS))


def calibrated(evidence_: CarEvidence, car: str) -> dict[str, CalibratedParameter]:
    return {
        k: parameter
        for k, parameter in evidence_.parameters(car).items()
        if isinstance(parameter, CalibratedParameter)
    }


def refusals(evidence_: CarEvidence, car: str) -> dict[str, str]:
    return {
        name: reason
        for name, reason in evidence_.parameters(car).items()
        if isinstance(reason, str)
    }


@pytest.fixture(scope="module")
def fleet() -> tuple[list[dict[str, Any]], dict[str, dict[str, float]]]:
    """Gram rows of 40 cars of three drives, and how their sensors are off."""
    rng = np.random.default_rng(20)
    rows, true = [], {}
    for i in range(40):
        car = f"car-{i:02d}"
        true[car] = {
            "yaw_rate_offset": 0.01 * rng.standard_normal(),
            "ay_offset": 0.15 * rng.standard_normal(),
            "steering_offset": 0.003 * rng.standard_normal(),
        }
        rows += [gram_row(car, n, biased(rng, true[car])) for n in range(3)]
    return rows, true


def test_offsets_lie_within_their_stated_uncertainty(fleet: Any) -> None:
    rows, true = fleet
    evidence_ = evidence(rows)
    for name in TRUE:
        errors = []
        for car, offsets in true.items():
            parameter = calibrated(evidence_, car)[name]
            assert parameter.uncertainty is not None
            errors.append((parameter.value - offsets[name]) / parameter.uncertainty)
        # 40 standard normal numbers: mean within 3 / sqrt(40), variance within 3 sqrt(2 / 40).
        assert abs(np.mean(errors)) < 0.48, name
        assert 0.33 < np.mean(np.square(errors)) < 1.67, name
        assert np.mean(np.abs(errors) < 2) > 0.85, name


def test_more_drives_make_it_surer_as_was_stated(fleet: Any) -> None:
    evidence_ = evidence(fleet[0])

    def after(car: str, first: int, last: int) -> tuple[dict[Any, float], dict[Any, float]]:
        at = evidence_.slices(car, first, last)
        estimates = evidence_.estimate(at)
        values = {name: float(estimate.value) for name, estimate in estimates.items()}
        return values, evidence_.uncertainties(estimates, at)

    single, other, repeated = (
        [after(car, *drives) for car in evidence_.cars] for drives in ((0, 1), (1, 2), (0, 2))
    )
    for name in TRUE:
        stated = np.mean([errors[name] ** 2 for _, errors in single])
        apart = [a[name] - b[name] for (a, _), (b, _) in zip(single, other, strict=True)]
        assert 0.6 < np.sqrt(np.mean(np.square(apart)) / 2 / stated) < 1.6, name
        with_two = np.mean([errors[name] ** 2 for _, errors in repeated])
        assert 0.55 < np.sqrt(with_two / stated) < 0.8, name  # 1 / sqrt(2), about


def test_the_numbers_are_the_same_in_any_order(fleet: Any) -> None:
    rows, _ = fleet
    shuffled = [*rows]
    random.Random(4).shuffle(shuffled)  # noqa: S311 - an order, no secret
    ordered, other = evidence(rows), evidence(shuffled, size=11)
    assert [calibrated(ordered, car) for car in ordered.cars] == [
        calibrated(other, car) for car in other.cars
    ]


def test_the_wheels_tell_the_radius_and_the_steering_the_wheelbase() -> None:
    rng = np.random.default_rng(3)
    rows = [gram_row("car", n, biased(rng, TRUE)) for n in range(4)]
    parameters = calibrated(evidence(rows), "car")
    assert parameters["speed_ratio"].value == pytest.approx(cars.RADIUS_M / 0.31, rel=1e-2)
    wheelbase = parameters["steer_per_curvature"].value * parameters["speed_ratio"].value
    assert wheelbase == pytest.approx(cars.WHEELBASE_M, rel=0.08)  # noise flattens
    assert parameters["understeer"].value == pytest.approx(0.002, abs=1e-3)


def on_real_roads(
    rng: np.random.Generator, offsets: dict[str, float], bank: float = -20
) -> dict[str, Any]:
    """Return the counts of a drive where bends are banked, roads fall and wheels differ."""

    def change(signals: cars.Signals) -> None:
        speed = cars.RADIUS_M * sum(signals[f"wheel_{c}"] for c in ("fl", "fr", "rl", "rr")) / 4
        signals["ay"] += offsets["ay_offset"] + 0.2 + bank * signals["yaw_rate"] / speed
        signals["yaw_rate"] += offsets["yaw_rate_offset"]
        signals["wheel_rr"] *= 1.004

    return cars.counts(cars.broken(cars.drive(rng, 1.5), change))


def test_roads_that_lean_and_are_banked_are_taken_out() -> None:
    rng = np.random.default_rng(11)
    rows, true = [], {}
    for i in range(12):
        car = f"car-{i:02d}"
        true[car] = {
            "yaw_rate_offset": 0.01 * rng.standard_normal(),
            "ay_offset": 0.05 * rng.standard_normal(),
        }
        rows += [gram_row(car, n, on_real_roads(rng, true[car])) for n in range(3)]
    evidence_ = evidence(rows)
    assert evidence_.roads.banked
    assert evidence_.roads.lean is not None
    assert float(evidence_.roads.lean) == pytest.approx(0.2, abs=0.06)
    for car, offsets in true.items():
        for name, offset in offsets.items():
            parameter = calibrated(evidence_, car)[name]
            assert parameter.uncertainty is not None
            assert abs(parameter.value - offset) < 4 * parameter.uncertainty, (car, name)

    alone = evidence([row for row in rows if row["vehicle_id"] < "car-08"])
    assert alone.roads.banked
    assert alone.roads.lean is None
    assert "ay_offset" not in calibrated(alone, "car-03")
    assert "10 cars" in refusals(alone, "car-03")["ay_offset"]
    assert set(refusals(evidence_, "car-03")) == {"slip_lever", "slip_compliance"}


def test_one_drive_is_as_sure_as_it_is_where_roads_differ() -> None:
    """A road's bank is its own: one drive explains it, and several at once do not."""
    rng = np.random.default_rng(31)
    rows = [
        gram_row(f"car-{i:02d}", n, on_real_roads(rng, NONE_OFF, bank=-rng.uniform(10, 60)))
        for i in range(15)
        for n in range(4)
    ]
    evidence_ = evidence(rows)
    assert evidence_.roads.banked
    squares = []
    for car in evidence_.cars:
        first = evidence_.slices(car, 0, 1)
        estimates = evidence_.estimate(first)
        if error := evidence_.uncertainties(estimates, first).get("yaw_rate_offset"):
            squares.append(float(estimates["yaw_rate_offset"].value) ** 2 / error**2)
    assert len(squares) > 12
    assert 0.33 < np.mean(squares) < 2


def test_the_lean_of_roads_is_what_the_cars_do_not_explain() -> None:
    offsets = [Fraction(i - 10, 100) for i in range(21)]
    assert estimate_roads(True, offsets).lean == 0
    leaning = estimate_roads(True, [offset + Fraction(1, 4) for offset in offsets])
    assert leaning.lean is not None
    assert 0.2 < leaning.lean < 0.25
    assert leaning.uncertainty == pytest.approx(
        hypot(31**0.5 / 3 * 0.05 / 21**0.5, 0.25 - float(leaning.lean))
    )
    assert estimate_roads(True, offsets[:9]).lean is estimate_roads(False, offsets).lean is None


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("one row", STRAIGHT),
        ("straight", STRAIGHT),
        ("even circle", STRAIGHT),
        ("constant speed", EVEN),
        ("other unit", NO_TYRE),
    ],
)
def test_parameters_without_evidence_are_left_out_with_a_reason(kind: str, why: str) -> None:
    rng = np.random.default_rng(5)
    signals = cars.drive(rng, 2.0)
    n = cars.TICKS
    if kind == "one row":
        signals = {name: values[:1] for name, values in signals.items()}
    elif kind == "straight":
        signals["yaw_rate"] = 0.01 * rng.standard_normal(n)
        signals["ay"] = 0.1 * rng.standard_normal(n)
        signals["steer_fl"] = signals["steer_fr"] = 2e-4 * rng.standard_normal(n)
    elif kind == "even circle":
        for name, values in signals.items():
            signals[name] = values.mean() + 0.3 + 0.01 * rng.standard_normal(n)
    elif kind == "other unit":
        signals["ay"] *= 0.5
    else:
        scale = 15 / (0.31 * sum(signals[f"wheel_{c}"] for c in ("fl", "fr", "rl", "rr")) / 4)
        for corner in ("fl", "fr", "rl", "rr"):
            signals[f"wheel_{corner}"] = signals[f"wheel_{corner}"] * scale
    evidence_ = evidence([gram_row("car", n, cars.counts(signals)) for n in range(2)])
    missing = refusals(evidence_, "car")
    for name in ("yaw_rate_offset", "ay_offset", "speed_ratio", "steering_offset"):
        assert name not in calibrated(evidence_, "car")
        assert missing[name] == why
    assert missing["slip_lever"] == NO_RECEIVER


def filled(warehouse: Warehouse, *names: str) -> None:
    rng = np.random.default_rng(8)
    for car in names:
        for number in range(2):
            counts = biased(rng, TRUE)
            counts.pop("sideslip" if car == "alfa" else "", None)  # drives without a label count
            rows = log_rows(f"{car}-{number}", counts, DAY, vehicle_id=car)
            land(warehouse, f"{car}-{number}", rows)
    update_grams(warehouse)


def test_a_warehouse_says_what_is_missing_and_forgets(warehouse: Warehouse) -> None:
    filled(warehouse, "alfa", "beta", "gamma")
    with pytest.raises(DataError, match="fleet-slip gram --features calibration"):
        calibrate(warehouse)
    update_grams(warehouse, feature_set="calibration")
    calibration = calibrate(warehouse)
    assert set(calibration.cars) == {"alfa", "beta", "gamma"}
    for car in calibration.cars:
        for name, value in TRUE.items():
            parameter = calibration.car(car)[name]  # type: ignore[index]
            assert parameter.uncertainty is not None
            assert abs(parameter.value - value) < 5 * parameter.uncertainty
    assert "10 cars or more separate the two" in str(done_on(warehouse.root, "calibrate"))
    with pytest.raises(QuestionError, match="delta"):
        calibration.car("delta")
    with pytest.raises(DataError, match="no drive of"):
        calibrate(warehouse, "vehicle_id = 'delta'")

    forget(warehouse, ErasureSubject("vehicle", "beta"))
    after = calibrate(warehouse)
    assert set(after.cars) == {"alfa", "gamma"}
    assert {c: after.cars[c]["ay_offset"].value for c in after.cars} == {
        c: calibration.cars[c]["ay_offset"].value for c in after.cars
    }
    for numbers in after.cars.values():
        parameter, grain = numbers["ay_offset"], float(CALIBRATION_PARAMETERS["ay_offset"].grain)
        assert abs(parameter.value - parameter.count * grain) <= grain / 2


def test_a_car_that_stood_still_tells_the_bias_of_its_gyroscope() -> None:
    """Drives that are too straight for other parameters; slow turns do not count as bias."""
    rng = np.random.default_rng(8)
    columns = ("yaw_rate", "wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
    rows = []
    for number in range(3):
        straight = cars.drive(rng, 2.0)
        straight["yaw_rate"], straight["ay"] = 0.01 * rng.standard_normal((2, cars.TICKS))
        rows.append(gram_row("car", number, cars.counts(straight)))
        rolled = np.arange(4000) < 300  # of rows below 3 m/s
        turn = 0.4 * rolled * rng.choice([1.0, 0.6, -0.2], 4000)
        track = 1.55 * turn / 0.31 / 2
        slow = {"yaw_rate": np.rint((0.0123 + turn + 0.002 * rng.standard_normal(4000)) / 1e-4)}
        for corner in ("fl", "fr", "rl", "rr"):
            side = 1 if corner.endswith("r") else -1
            slow[f"wheel_{corner}"] = np.rint((5.0 * rolled + side * track) / 0.01)
        counts = np.stack([slow[name].astype(np.int64) for name in columns], axis=1)
        rows.append(row_of(columns, counts, rows[-1]["drive_id"]))
    evidence_ = evidence(rows)
    assert set(refusals(evidence_, "car")) >= {"ay_offset", "steering_offset"}
    parameter = calibrated(evidence_, "car")["yaw_rate_offset"]
    assert parameter.value == pytest.approx(0.0123, abs=2e-4)
    assert parameter.uncertainty is not None and 0.0003 <= parameter.uncertainty < 0.001
    assert (parameter.drives, parameter.rows) == (3, 12000)


RATIO, LEVER_M, COMPLIANCE, BIAS_RAD = 1.07, 1.3, -0.006, 0.004
BY_SET = {
    set_: columns for set_, kind in kinds_by_set(SIGNALS.label).items() for columns in kind.values()
}


def levels(rng: np.random.Generator) -> dict[str, Any]:
    """Return the counts of a drive whose receiver is half a second late, and noisy."""
    time_s = np.arange(6000) * 0.1
    speed = 15 + 8 * np.sin(time_s / 20)
    late = RATIO * (15 + 8 * np.sin((time_s - 0.5) / 20)) + 0.1 * rng.standard_normal(6000)
    counts = {name: np.rint(speed / 0.31 / 0.01) for name in BY_SET[BY_SATELLITE][:4]}
    satellite = np.rint(late / float(SIGNALS["satellite_speed"].scale))
    return {**counts, "slowness": np.rint(1 / speed / 4e-5), "satellite_speed": satellite}


def changes(rng: np.random.Generator) -> dict[str, Any]:
    """Return the counts of changes of a drive whose gyroscope is off by a bias and a scale."""
    curvature, ay, turned = rng.standard_normal((3, 5000)) * [[0.01], [2.0], [0.3]]
    label = LEVER_M * curvature + COMPLIANCE * ay + BIAS_RAD + 0.01 * turned
    label += 0.002 * rng.standard_normal(5000)
    scales = {name: float(scale) for name, scale in CATALOG.input_scales.items()}
    columns_by_name = {"curvature": curvature, "ay": ay, TURNED: turned, SIGNALS.label: label}
    scales |= {TURNED: turned_scale(SIGNALS), SIGNALS.label: float(SIGNALS[SIGNALS.label].scale)}
    return {name: np.rint(values / scales[name]) for name, values in columns_by_name.items()}


def stacked(columns: Sequence[str], counts: dict[str, Any]) -> Any:
    return np.stack([counts[name] for name in columns], axis=1)


@pytest.fixture(scope="module")
def course_parameters() -> dict[str, CalibratedParameter]:
    rng = np.random.default_rng(5)
    sums: dict[str, DriveSums] = {}
    for name, make in ((BY_SATELLITE, levels), (BY_COURSE, changes)):
        rows = [
            row_of(BY_SET[name], stacked(BY_SET[name], make(rng)), f"drive-{drive}")
            for drive in range(4)
        ]
        sums |= collect_sums([pa.RecordBatch.from_pylist(rows)], kinds_by_set(SIGNALS.label)[name])
    stated = CarEvidence(CATALOG, sums).parameters("car")
    return {
        name: parameter
        for name, parameter in stated.items()
        if isinstance(parameter, CalibratedParameter)
    }


def test_a_late_receiver_tells_the_speed_ratio(
    course_parameters: dict[str, CalibratedParameter],
) -> None:
    parameter = course_parameters["speed_ratio"]
    assert parameter.value == pytest.approx(RATIO, abs=1e-3)
    assert parameter.uncertainty is not None
    assert 0.0012 <= parameter.uncertainty < 0.003


def test_the_course_tells_how_a_car_slips(
    course_parameters: dict[str, CalibratedParameter],
) -> None:
    assert course_parameters["slip_lever"].value == pytest.approx(LEVER_M, abs=0.01)
    assert course_parameters["slip_compliance"].value == pytest.approx(COMPLIANCE, abs=1e-4)
    bias = course_parameters[
        "yaw_rate_offset"
    ]  # over 4 s the heading gains that much, and the label lacks it
    assert bias.value == pytest.approx(-BIAS_RAD / 4, abs=3e-5)
    assert bias.uncertainty is not None and 1e-4 <= bias.uncertainty < 2e-4


@pytest.mark.parametrize("times", [0, 5])
def test_a_course_of_another_car_yields_nothing(times: int) -> None:
    """A heading has no lever; that of an antenna far away is none of a car."""
    counts = changes(np.random.default_rng(6))
    counts[SIGNALS.label] = times * counts[SIGNALS.label]
    columns = BY_SET[BY_COURSE]
    table = stacked(columns, counts).astype(np.int64)
    parameters = estimate_parameters(
        CarTerms(CATALOG), {"slip": Gram.from_counts(columns, table)}, banked=False
    )
    assert {*parameters.values()} == {NO_COURSE, NO_CAR}
    assert parameters["slip_lever"] == parameters["slip_compliance"] == NO_CAR
