"""The delay of a receiver is found in Gram rows, and a model that a late course taught refused."""

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import RefusedError
from fleet_slip.grams.rows.receiver_delay import ReceiverDelay, with_pooled

CAMPAIGN = """
name = "late"
description = "Drives with receivers that are late"
base = "smoke"
drives_per_day = 4
laps = 1

[receivers]
delay_error_s = {{ min = {0}, max = {0} }}

[[receivers.types]]
rate_hz = 10
velocity_std_mps = 0.03
time_between_outages_s = 60.0
outage_duration_s = 5.0
"""
DELAYS = "SELECT value, uncertainty, drives FROM calibration WHERE number = 'receiver_delay'"


def late_fleet(folder: Path, delay_s: float, grams: Sequence[str] = ("signals", "delay")) -> Fleet:
    file = folder / "late.toml"
    file.write_text(CAMPAIGN.format(delay_s))
    fleet = fleet_slip.open(folder / "data")
    fleet.simulate(str(file))
    for name in grams:
        fleet.gram(name)
    return fleet


@pytest.mark.parametrize("delay_s", [0.0, 0.087, 0.3])
def test_the_delay_is_found_with_its_uncertainty(tmp_path: Path, delay_s: float) -> None:
    fleet = late_fleet(tmp_path, delay_s)
    with fleet.session(DELAYS) as session:
        ((value, uncertainty, drives),) = session.sql(DELAYS).fetchall()
    assert drives == 8
    assert abs(value - delay_s) < 0.005
    assert 0 < uncertainty < 0.005
    assert abs(value - delay_s) < 3 * uncertainty + 0.001


def test_a_car_of_few_drives_is_as_sure_as_usual_drives_make_it() -> None:
    known, few = ReceiverDelay(0.1, 0.004, 4, 9000), ReceiverDelay(0.09, None, 1, 2000)
    assert with_pooled({"a": few}) == {"a": few}
    found = with_pooled({"a": few, "b": known})
    assert found["b"] == known
    assert found["a"].uncertainty == pytest.approx(math.sqrt(4 * (0.004**2 - 0.003**2) + 0.003**2))


MODEL = "steering_mean_16,ay_mean_16,ay_square_mean_8,yaw_rate_speed_mean_8"
CORRECTED = """
    SELECT drive_id, signals, course_late, n, sums, products FROM grams
    WHERE feature_set LIKE 'course-%' ORDER BY ALL
"""


def corrected_rows(fleet: Fleet) -> list[tuple[Any, ...]]:
    with fleet.session(CORRECTED) as session:
        return session.sql(CORRECTED).fetchall()


def test_a_late_course_teaches_what_one_in_time_does(tmp_path: Path) -> None:
    """From one command: the Gram rows that tell the delay are computed by it."""
    coefficients = []
    for delay_s in (0.0, 0.187):
        (tmp_path / str(delay_s)).mkdir()
        fleet = late_fleet(tmp_path / str(delay_s), delay_s, grams=("signals", "course"))
        assert {row[2] for row in corrected_rows(fleet)} <= {
            round(delay_s / 0.0025) + off for off in (-1, 0, 1)
        }
        fleet.gram("calibration")
        selection = fleet.cohort("true").select(label="course", model=MODEL)
        coefficients.append([float(c) for c in selection.winner.model.model.coefficients])
        assert fleet.publish("in_time", selection).new
    assert coefficients[1] == pytest.approx(coefficients[0], rel=0.1)


def test_gram_rows_follow_the_delay_that_more_drives_tell(tmp_path: Path) -> None:
    fleet = late_fleet(tmp_path, 0.187, grams=("signals",))
    ((first,), *_) = fleet.sql("SELECT min(day) FROM drives").fetchall()
    fleet.gram("course", cohort=f"day = '{first}'")
    early = corrected_rows(fleet)
    assert fleet.gram("course").changed
    rows = corrected_rows(fleet)
    assert len({row[2] for row in rows}) == 1
    assert len(rows) > len(early)
    assert not fleet.gram("course").changed
    assert fleet.check().wide_drives


def test_what_a_forgotten_drive_told_of_the_delay_is_gone(tmp_path: Path) -> None:
    fleet = late_fleet(tmp_path, 0.187, grams=("signals", "course"))
    ((drive,), *_) = fleet.sql("SELECT min(drive_id) FROM drives").fetchall()
    fleet.forget(drive=drive)
    kept = corrected_rows(fleet)
    assert drive not in {row[0] for row in kept}
    other = fleet_slip.open(tmp_path / "anew")
    shutil.copytree(tmp_path / "data" / "logs", tmp_path / "anew" / "logs")
    for name in ("signals", "course"):
        other.gram(name)
    assert corrected_rows(other) == kept


def test_what_a_course_of_unknown_delay_taught_is_not_published(tmp_path: Path) -> None:
    fleet = late_fleet(tmp_path, 0.06, grams=("signals", "calibration"))
    drives = [drive for (drive,) in fleet.sql("SELECT drive_id FROM drives").fetchall()]
    few = f"drive_id <= '{sorted(drives)[1]}'"
    fleet.gram("course", cohort=few)
    selection = fleet.cohort(few).select(label="course", model="steering_mean_16,ay_mean_16")
    with pytest.raises(RefusedError, match=r"not known to 5 ms \(late-0000: \d\d ms, of too few"):
        fleet.publish("late", selection)
    assert fleet.publish("late", selection, force=True).new


def test_quality_names_a_car_whose_delay_changed(tmp_path: Path) -> None:
    fleet = late_fleet(tmp_path, 0.06)
    assert not changed(fleet)
    later = CAMPAIGN.format(0.187) + "\n"
    (tmp_path / "later.toml").write_text(
        later.replace('base = "smoke"', 'base = "smoke"\nfirst_day = 2024-06-01')
    )
    fleet.simulate(str(tmp_path / "later.toml"))
    for name in ("signals", "delay"):
        fleet.gram(name)
    found = changed(fleet)
    assert len(found) == 16
    assert found[0].startswith("5") or found[0].startswith("6")
    assert found[0].endswith(" ms since")
    assert " before 2024-06-01, 18" in found[0]


def changed(fleet: Fleet) -> list[str]:
    findings = fleet.quality("true").findings
    return [one.fault.figure for one in findings if one.fault.kind == "changed delay"]
