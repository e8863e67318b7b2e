"""A fleet of which few cars have a reference sensor, or none: what the course of all teaches."""

import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, UsageError
from fleet_slip.grams.cohort import load_cohort, load_mixed_labels
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import fit
from tests.support.logs import land

CAMPAIGN = """
name = "some"
description = "A few cars with receivers"
base = "fleet"
number_of_days = 1
drives_per_day = 12

[[receivers.types]]
rate_hz = 10
velocity_std_mps = 0.03
time_between_outages_s = 60.0
outage_duration_s = 5.0
"""
COLUMNS = "steering_mean_16,ay_mean_16,ay_square_mean_16,yaw_rate_speed_mean_16"
SETS = ("signals", "delay", "calibration", "windows", "course")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """Drives of which those of two cars alone have the label."""
    folder = tmp_path_factory.mktemp("some")
    (folder / "some.toml").write_text(CAMPAIGN)
    fleet_slip.open(folder / "labelled").simulate(str(folder / "some.toml"))
    files = sorted(folder.glob("labelled/logs/**/*.parquet"))
    logs = pl.read_parquet(files, missing_columns="insert", hive_partitioning=True)
    names = sorted(logs["vehicle_id"].unique().to_list())
    label = catalogue().label
    known = pl.when(pl.col("vehicle_id").is_in(names[:2])).then(pl.col(label))
    drives = logs.with_columns(known.otherwise(None).alias(label))
    absent = [pl.lit(None).alias(n) for n in catalogue().log_schema.names if n not in logs.columns]
    table = drives.with_columns(absent).select(catalogue().log_schema.names).to_arrow()
    day = logs["day"][0]
    made = fleet_slip.open(folder / "data")
    land(made.warehouse, "all", table.cast(catalogue().log_schema), day=day)
    for name in SETS:
        made.gram(name)
    return made


@pytest.fixture
def fleet(two: Fleet, tmp_path: Path) -> Fleet:
    return fleet_slip.open(shutil.copytree(str(two.root), tmp_path / "data"))


def test_both_teach_with_a_weight(fleet: Fleet) -> None:
    selection = fleet.cohort("true").select(label="course+sideslip", model=COLUMNS)
    assert len(selection.winner.model.folds) == 2 and selection.winner.model.drives == 2
    assert selection.winner.model.pooled.rmse_deg < 0.2, "of the angle, without fixes' noise"
    manifest = fleet.publish("both", selection, force=True).version.manifest
    learned = manifest.learned_from
    assert learned is not None and learned.label == "course+sideslip"
    assert learned.weight is not None and 0 < learned.weight <= 256
    assert manifest.trained_on.vehicles == 12 and manifest.trained_on.drives == 12
    # Each car has the intercept of its own offsets, which no change tells.
    assert manifest.signals[-2:] == ("ay_offset_alone", "yaw_rate_offset_alone")
    again = fleet.cohort("true").select(label="course+sideslip", model=COLUMNS)
    assert not fleet.publish("both", again, force=True).new


def test_a_large_weight_is_the_course_alone_and_a_small_one_the_label(fleet: Fleet) -> None:
    inputs, label = COLUMNS.split(","), catalogue().label
    cohort = load_mixed_labels(fleet.warehouse, "true", "course", "vehicle")
    course = load_cohort(fleet.warehouse, "true", "course")
    taught = set(cohort.drives["vehicle_id"].to_pylist())
    alone = course.part(
        np.array([car not in taught for car in course.drives["vehicle_id"].to_pylist()])
    )

    def slopes(gram: Gram) -> list[float]:
        return [float(one) for one in fit(gram, inputs, label).model.coefficients]

    def weighted(weight: Fraction) -> list[float]:
        folds = replace(cohort, weight=weight).folds("vehicle", 5)
        return slopes(folds.serving(inputs, label).total)

    of_course = slopes(alone.serving(inputs).table.total())
    assert weighted(Fraction(2**40)) == pytest.approx(of_course, rel=1e-6)
    of_label = slopes(cohort.serving(inputs).table.total())
    assert weighted(Fraction(1, 2**40)) == pytest.approx(of_label, rel=1e-6)
    assert of_label != pytest.approx(of_course, rel=1e-2)


def test_what_cannot_be_asked_of_both_is_said(fleet: Fleet) -> None:
    cohort = fleet.cohort("true")
    with pytest.raises(UsageError, match="leave out nested"):
        cohort.select(label="course+sideslip", rank="backward")
    cars = [car for (car,) in fleet.sql("SELECT DISTINCT vehicle_id FROM drives").fetchall()]
    last = f"vehicle_id = '{max(cars)}'"
    with pytest.raises(DataError, match="Learn from the course alone"):
        fleet.cohort(last).select(label="course+sideslip", model=COLUMNS)
