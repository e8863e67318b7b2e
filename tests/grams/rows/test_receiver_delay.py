"""The delay of a receiver is found in Gram rows, and a model that a late course taught refused."""

from pathlib import Path

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


def late_fleet(folder: Path, delay_s: float) -> Fleet:
    file = folder / "late.toml"
    file.write_text(CAMPAIGN.format(delay_s))
    fleet = fleet_slip.open(folder / "data")
    fleet.simulate(str(file))
    for name in ("signals", "delay"):
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
    known, few = ReceiverDelay(0.1, 0.002, 4, 9000), ReceiverDelay(0.09, None, 1, 2000)
    assert with_pooled({"a": few}) == {"a": few}
    found = with_pooled({"a": few, "b": known})
    assert found["b"] == known
    assert found["a"].uncertainty == pytest.approx(0.004)


def test_what_a_late_course_taught_is_not_published(tmp_path: Path) -> None:
    fleet = late_fleet(tmp_path, 0.06)
    for name in ("course", "calibration"):
        fleet.gram(name)
    selection = fleet.cohort("true").select(label="course", model="steering_mean_16,ay_mean_16")
    with pytest.raises(RefusedError, match=r"late: late-0000 by 6\d \+- \d ms.*delay_s"):
        fleet.publish("late", selection)
    assert fleet.publish("late", selection, force=True).new
