"""What satellites tell of a car: the numbers that its rows were made with."""

from datetime import date
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.course import TURNED, turned_scale
from fleet_slip.catalogue.facts import BY_COURSE, BY_SATELLITE
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.calibration import CalibratedNumber, CarEvidence
from fleet_slip.grams.car_estimates import NO_CAR, NO_COURSE, estimate_numbers, kinds_by_set
from fleet_slip.grams.reader import DriveSums, collect_sums
from fleet_slip.regression.gram import Gram

RATIO, LEVER_M, COMPLIANCE, BIAS_RAD = 1.07, 1.3, -0.006, 0.004
COLUMNS = {set_: columns for set_, kind in kinds_by_set().items() for columns in kind.values()}


def levels(rng: np.random.Generator) -> dict[str, Any]:
    """Return the counts of a drive whose receiver is half a second late, and noisy."""
    time_s = np.arange(6000) * 0.1
    speed = 15 + 8 * np.sin(time_s / 20)
    late = RATIO * (15 + 8 * np.sin((time_s - 0.5) / 20)) + 0.1 * rng.standard_normal(6000)
    counts = {name: np.rint(speed / 0.31 / 0.01) for name in COLUMNS[BY_SATELLITE][:4]}
    satellite = np.rint(late / float(catalogue()["satellite_speed"].scale))
    return {**counts, "slowness": np.rint(1 / speed / 4e-5), "satellite_speed": satellite}


def changes(rng: np.random.Generator) -> dict[str, Any]:
    """Return the counts of changes of a drive whose gyroscope is off by a bias and a scale."""
    curvature, ay, turned = rng.standard_normal((3, 5000)) * [[0.01], [2.0], [0.3]]
    label = LEVER_M * curvature + COMPLIANCE * ay + BIAS_RAD + 0.01 * turned
    label += 0.002 * rng.standard_normal(5000)
    scales = {name: float(scale) for name, scale in input_scales().items()}
    wanted = {"curvature": curvature, "ay": ay, TURNED: turned, catalogue().label: label}
    scales |= {
        TURNED: turned_scale(),
        catalogue().label: float(catalogue()[catalogue().label].scale),
    }
    return {name: np.rint(values / scales[name]) for name, values in wanted.items()}


def row(columns: tuple[str, ...], drive: int, counts: dict[str, Any]) -> dict[str, Any]:
    gram = Gram.from_counts(
        columns, np.stack([counts[c].astype(np.int64) for c in columns], axis=1)
    )
    return {
        "vehicle_id": "car",
        "day": date(2024, 5, 1),
        "drive_id": f"drive-{drive}",
        "signals": ",".join(columns),
        "n": gram.n,
        "sums": list(gram.sums),
        "products": list(gram.products),
    }


@pytest.fixture(scope="module")
def told() -> dict[str, CalibratedNumber]:
    rng = np.random.default_rng(5)
    sums: dict[str, DriveSums] = {}
    for name, make in ((BY_SATELLITE, levels), (BY_COURSE, changes)):
        rows = [row(COLUMNS[name], drive, make(rng)) for drive in range(4)]
        sums |= collect_sums([pa.RecordBatch.from_pylist(rows)], kinds_by_set()[name])
    stated = CarEvidence(sums).stated("car")
    return {name: one for name, one in stated.items() if isinstance(one, CalibratedNumber)}


def test_the_sets_have_the_columns() -> None:
    for name, columns in COLUMNS.items():
        assert set(columns) <= set(features().feature_set(name).columns)


def test_a_late_receiver_tells_the_speed_ratio(told: dict[str, CalibratedNumber]) -> None:
    one = told["speed_ratio"]
    assert one.value == pytest.approx(RATIO, abs=1e-3)
    assert one.uncertainty is not None
    assert 0.0012 <= one.uncertainty < 0.003


def test_the_course_tells_how_a_car_slips(told: dict[str, CalibratedNumber]) -> None:
    assert told["slip_lever"].value == pytest.approx(LEVER_M, abs=0.01)
    assert told["slip_compliance"].value == pytest.approx(COMPLIANCE, abs=1e-4)
    bias = told["yaw_rate_offset"]  # over 4 s the heading gains that much, and the label lacks it
    assert bias.value == pytest.approx(-BIAS_RAD / 4, abs=3e-5)
    assert bias.uncertainty is not None and 1e-4 <= bias.uncertainty < 2e-4


@pytest.mark.parametrize("times", [0, 5])
def test_what_is_no_course_of_a_car_tells_nothing(times: int) -> None:
    """A heading has no lever; that of an antenna far away is none of a car."""
    counts = changes(np.random.default_rng(6))
    counts[catalogue().label] = times * counts[catalogue().label]
    columns = COLUMNS[BY_COURSE]
    table = np.stack([counts[name].astype(np.int64) for name in columns], axis=1)
    told = estimate_numbers({"slip": Gram.from_counts(columns, table)}, banked=False)
    assert {*told.values()} == {NO_COURSE, NO_CAR}
    assert told["slip_lever"] == told["slip_compliance"] == NO_CAR
