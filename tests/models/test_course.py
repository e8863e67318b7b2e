"""A model of the side-slip angle from logs without a label: as good as one that had it, nearly."""

import math
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.calibration.receiver_delay import ReceiverDelays, receiver_delays
from fleet_slip.errors import DataError, QuestionError, RefusedError
from fleet_slip.export.c_gram import sets_on_board
from fleet_slip.models import acceptance
from fleet_slip.models.manifest import Manifest
from tests.export.compiled import START_S, build, needs_cc
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.counted_rows import rows_of_messages, write_counted

CAMPAIGN = """
name = "received"
description = "Short drives with receivers"
base = "smoke"
laps = 1

[[receivers.types]]
rate_hz = 10
velocity_std_mps = 0.03
time_between_outages_s = 60.0
outage_duration_s = 5.0
"""
ROUND = """
laps = 4

[plan]
kind = "grid"
vehicles = ["d_class_sedan"]
mass_kg = [1320.0]
tracks = ["skid_pad"]
adhesion = [1.0]
lateral_mps2 = [4.0]
speed_factor = [0.7, 1.0]
acceleration_mps2 = 2.5
braking_mps2 = 4.0
top_speed_mps = 45.0
"""
COLUMNS = "steering_mean_16,ay_mean_16,ay_square_mean_8,yaw_rate_speed_mean_8"


@pytest.fixture(scope="module")
def uncalibrated(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    folder = tmp_path_factory.mktemp("course")
    file = folder / "received.toml"
    file.write_text(CAMPAIGN)
    fleet = fleet_slip.open(folder / "data")
    fleet.simulate(str(file))
    for name in ("signals", "course"):
        fleet.gram(name)
    return fleet


@pytest.fixture(scope="module")
def calibrated(uncalibrated: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrated") / "data"
    fleet = fleet_slip.open(shutil.copytree(str(uncalibrated.root), folder))
    for name in ("calibration", "delay", "windows"):
        fleet.gram(name)
    return folder


@pytest.fixture
def fleet(calibrated: Path, tmp_path: Path) -> Fleet:
    return fleet_slip.open(shutil.copytree(calibrated, tmp_path / "data"))


def without_label(fleet: Fleet) -> Manifest:
    selection = fleet.cohort("true").select(label="course", model=COLUMNS)
    return fleet.models.publish("freed", selection).version.manifest


def test_the_intercept_needs_the_calibration_and_the_columns(
    uncalibrated: Fleet, tmp_path: Path
) -> None:
    selection = uncalibrated.cohort("true").select(label="course", model=COLUMNS)
    with pytest.raises(DataError, match="fleet-slip gram --features calibration"):
        uncalibrated.models.publish("too_early", selection)
    fleet = fleet_slip.open(shutil.copytree(str(uncalibrated.root), tmp_path / "data"))
    fleet.gram("calibration")
    with pytest.raises(DataError, match="fleet-slip gram --features windows"):
        fleet.models.publish(
            "too_early", fleet.cohort("true").select(label="course", model=COLUMNS)
        )
    through = uncalibrated.cohort("true").select(label="course", model=COLUMNS, intercept=False)
    manifest = uncalibrated.models.publish("none", through, force=True).version.manifest
    assert manifest.intercept == 0 and manifest.learned_from and manifest.learned_from.cars == 0


def test_a_model_without_a_label_is_one_of_the_angle(fleet: Fleet) -> None:
    manifest = without_label(fleet)
    assert manifest.signals == tuple(COLUMNS.split(","))
    learned = manifest.learned_from
    assert learned is not None and (learned.label, learned.change_s, learned.cars) == (
        "course",
        4.0,
        1,
    )
    assert learned.intercept_uncertainty_deg is not None
    assert learned.intercept_uncertainty_deg == pytest.approx(0.15, rel=0.02), "what all share"
    score = fleet.evaluation.score("freed")
    assert score.correlation is not None and score.correlation > 0.995
    # The label's noise, 0.0286 deg, is in it.
    assert score.error_std_deg < 0.06 and abs(score.error_mean_deg) < 0.02
    assert manifest.intercept != 0 and manifest.cross_validation.error_mean_deg == 0


@needs_cc
def test_cars_without_a_log_or_a_label_teach_the_very_same_model(
    fleet: Fleet, tmp_path: Path
) -> None:
    """The sums that cars count on board, and nothing else; a drive has some kilobytes."""
    taught = without_label(fleet)
    counter = build(tmp_path, sets_on_board(CATALOG, taught), "-O0")
    logged = fleet.sql(
        "SELECT drive_id, any_value(course_delay_quarter_ticks) FROM grams "
        "WHERE course_delay_quarter_ticks IS NOT NULL GROUP BY drive_id ORDER BY drive_id"
    ).fetchall()
    columns = ", ".join(name for name in counter.signals if name != SIGNALS.label)
    sent = []
    for number, (drive, late) in enumerate(logged):
        rows = fleet.sql(
            f"SELECT tick, vehicle_id, {columns}, NULL::SMALLINT AS {SIGNALS.label} "
            f"FROM log_counts WHERE drive_id = '{drive}' ORDER BY tick"
        )
        sent.append(counter.messages(rows.to_arrow_table(), late, START_S + 86_400 * number))
    edge = fleet_slip.open(tmp_path / "edge")
    edge.import_onboard_grams(write_counted(tmp_path / "rows", rows_of_messages(b"".join(sent))))
    selection = without_label(edge)
    assert selection.trained_on.drives_without_log == selection.trained_on.drives == len(logged)
    assert (selection.intercept, selection.terms) == (taught.intercept, taught.terms)
    assert selection.learned_from == taught.learned_from
    assert max(map(len, sent)) < 5_000


def test_a_course_of_another_place_is_refused(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the receiver were known to be 200 ms late: then the place is 4 m from where it was."""
    cars = fleet.sql("SELECT DISTINCT vehicle_id FROM drives").fetchall()
    late = {car: 0.2 for (car,) in cars}
    monkeypatch.setattr("fleet_slip.models.acceptance._require_in_time", lambda *_: late)
    with pytest.raises(RefusedError, match="course of 1 of 1 car is implausible") as refused:
        without_label(fleet)
    assert "Check antenna_x_m" in str(refused.value)


@pytest.mark.parametrize(("uncertainty_s", "is_allowed"), [(0.006, True), (0.03, False)])
def test_a_delay_may_be_as_uncertain_as_its_effect_on_the_label_is_small(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, uncertainty_s: float, is_allowed: bool
) -> None:
    def estimate(batches: Iterable[pa.RecordBatch]) -> ReceiverDelays:
        delays = receiver_delays(batches)
        cars = {c: replace(d, uncertainty=uncertainty_s) for c, d in delays.cars.items()}
        return replace(delays, cars=cars)

    monkeypatch.setattr(acceptance, "receiver_delays", estimate)
    if is_allowed:
        assert without_label(fleet).learned_from
        return
    with pytest.raises(RefusedError, match=r"\+- 30 ms; they may cause more than 0\.15 deg"):
        without_label(fleet)


def test_the_same_again_is_nothing_new_and_the_gate_compares_changes(fleet: Fleet) -> None:
    first = without_label(fleet)
    assert without_label(fleet) == first
    fewer = fleet.cohort("true").select(label="course", model="ay_mean_16")
    with pytest.raises(RefusedError, match="worse than the champion"):
        fleet.models.publish("freed", fewer)


def test_columns_are_searched_for(fleet: Fleet) -> None:
    selection = fleet.cohort("true").select(label="course")
    (searched,) = selection.searched
    assert searched is not None and len(selection.winner.model.signals) <= 6
    assert math.isclose(selection.winner.model.pooled.error_mean_deg, 0, abs_tol=1e-9)
    assert selection.model_list == "course"
    summary = selection.without_label
    assert (
        summary is not None
        and summary.noise_deg is not None
        and summary.angle_at_most_deg is not None
    )
    # The noise of two fixes of 0.03 m/s each, at 15 to 45 m/s.
    assert (
        0.05 < summary.noise_deg < 0.2 < summary.error_deg
        and summary.noise_uncertainty_deg is not None
    )
    assert 0.02 < summary.angle_at_most_deg < summary.error_deg / math.sqrt(2)
    assert summary.one_way is None and -0.4 < summary.turn_balance < -0.1


def test_cars_that_turn_to_one_side_alone_are_told(tmp_path: Path) -> None:
    file = tmp_path / "round.toml"
    file.write_text(CAMPAIGN.replace("laps = 1", ROUND))
    fleet = fleet_slip.open(tmp_path / "data")
    fleet.simulate(str(file), days=1)
    for name in ("signals", "course"):
        fleet.gram(name)
    summary = fleet.cohort("true").select(label="course", model=COLUMNS).without_label
    assert summary is not None and summary.one_way == "left" and summary.turn_balance > 0.95


def test_a_set_without_changes_has_no_course(fleet: Fleet) -> None:
    with pytest.raises(QuestionError, match="Feature sets that have: course"):
        fleet.cohort("true").select(label="course", features="windows", model="ay_mean_16")


def test_a_fleet_without_receivers_is_told_so(smoke_copy: Path) -> None:
    plain = fleet_slip.open(smoke_copy)
    plain.gram("course")
    assert plain.gram("course").rows_read == 0, "nothing is left to do"
    cohort = plain.cohort("true")
    with pytest.raises(DataError, match="no course to learn from"):
        cohort.select(label="course", model=COLUMNS)
    with pytest.raises(DataError, match="no course to learn from"):
        cohort.select(label="course", order="ay", ranking="declared")
