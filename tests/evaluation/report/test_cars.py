"""A fleet car by car: the error in each car by models of the others, and its picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.base import FloatArray
from fleet_slip.catalogue.features import input_scales
from fleet_slip.evaluation.fleet_cars import (
    FEWEST_CARS,
    FOLDS,
    Cars,
    errors_by_car,
    largest_fleet,
    weigh_cars,
)
from fleet_slip.evaluation.pictures import draw_pictures
from fleet_slip.evaluation.report import render
from fleet_slip.evaluation.report_data import ReportData
from fleet_slip.grams.cohort import Cohort
from fleet_slip.grams.folding import assign_folds
from fleet_slip.grams.job import update_grams
from fleet_slip.pages.drawing import DESK, PHONE
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, random_counts
from tests.support.reported import Reported

SIGNALS = ("ay", "yaw_rate", "sideslip")
CARS = Cars("fleet", np.array([0.1, 0.2, 0.4]), np.array([0.05, 0.3, 0.1]), 0.25, 0.125, 48, 76)


def counts() -> dict[str, list[FloatArray]]:
    """Return the rows of two drives of each of 30 cars, which differ in what they make of ay."""
    generator = np.random.default_rng(11)
    found = {}
    for number in range(30):
        inputs = generator.integers(-4000, 4000, (2, 50, 2))
        label = inputs @ [0.1 + 0.002 * number, -0.2] + generator.normal(0, 9, (2, 50))
        found[f"car-{number:02}"] = list(np.dstack([inputs, np.rint(label)]))
    return found


def cohort(rows: dict[str, list[FloatArray]]) -> Cohort:
    drives = [(car, drive) for car, drives in rows.items() for drive in drives]
    grams = [Gram.from_counts(SIGNALS, drive.astype(np.int64)) for _, drive in drives]
    table = GramTable(
        SIGNALS,
        np.array([gram.n for gram in grams]),
        np.array([gram.sums for gram in grams]),
        np.array([gram.products for gram in grams]),
    )
    ids = [str(number) for number in range(len(drives))]
    about = pa.table({"drive_id": ids, "vehicle_id": [car for car, _ in drives]})
    condition = parse_condition("true")
    return Cohort(
        condition=condition, tables=(table,), drives=about, logs_version=1, grams_version=1
    )


def test_each_car_is_judged_by_a_line_through_the_cars_of_other_folds() -> None:
    rows = counts()
    found, of_all = errors_by_car(cohort(rows), SIGNALS[:2])
    cars = sorted(rows)
    folds = assign_folds(cars, "vehicle", FOLDS)
    squares: dict[str, FloatArray] = {}
    for car, fold in zip(cars, folds.fold, strict=True):
        others = np.concatenate(
            [d for c, f in zip(cars, folds.fold, strict=True) if f != fold for d in rows[c]]
        )
        design = np.column_stack([others[:, :2], np.ones(len(others))])
        weights = np.linalg.lstsq(design, others[:, 2], rcond=None)[0]
        own = np.concatenate(rows[car])
        squares[car] = (np.column_stack([own[:, :2], np.ones(100)]) @ weights - own[:, 2]) ** 2
    count_deg = np.degrees(float(input_scales()["sideslip"]))
    assert set(found) == set(cars)
    for car, square in squares.items():
        assert found[car] == pytest.approx(count_deg * np.sqrt(square.mean()), rel=1e-6)
    pooled = np.concatenate(list(squares.values()))
    assert of_all == pytest.approx(count_deg * np.sqrt(pooled.mean()), rel=1e-6)


def test_one_car_is_no_fleet(reported: Reported, data: ReportData) -> None:
    assert weigh_cars(Warehouse(LocalFolder(reported.root))) is None
    assert data.cars is None
    assert not [one for one in draw_pictures(data) if one.key.startswith("fleet-")]


def test_a_fleet_without_gram_rows_is_not_drawn(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    counts = random_counts(np.random.default_rng(2), 30)
    numbers = range(FEWEST_CARS)
    drives = [log_rows(f"{n}", counts, vehicle_id=f"car {n}", campaign="it's") for n in numbers]
    land(warehouse, "one", *drives)
    update_grams(warehouse)
    assert largest_fleet(warehouse) == "it's"
    assert weigh_cars(warehouse) is None


def test_a_fleet_has_a_section_with_its_picture(reported: Reported, data: ReportData) -> None:
    without = (reported.root / "report" / "report.html").read_text()
    assert 'id="fleet"' not in without
    assert "for want of a model with gates and of a fleet in this" in without
    with_fleet = replace(data, cars=CARS)
    (picture,) = [one for one in draw_pictures(with_fleet) if one.key == "fleet-cars"]
    assert "3 cars" in picture.caption
    assert "67 % of the cars gain" in picture.caption
    assert "0.250° with 48 inputs, 0.125° with 76" in picture.caption
    page = render(with_fleet, [picture])
    assert 'id="fleet"' in page
    assert "for want of a model with gates in this" in page
    assert "car by car, before and after calibration" in page
    for size in (DESK, PHONE):
        (axes,) = picture.draw(size).axes
        drawn = [np.asarray(line.get_ydata()) for line in axes.get_lines()]
        before, after = (values for values in drawn if len(values) > 2)
        np.testing.assert_array_equal(before, CARS.before_deg)
        np.testing.assert_array_equal(after, CARS.after_deg)
