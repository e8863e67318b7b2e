"""The delay of a receiver is found in Gram rows, and a model that a late course taught refused."""

import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.calibration.receiver_delay import (
    ReceiverDelay,
    course_delays,
    receiver_delays,
    with_pooled,
)
from fleet_slip.catalog.definitions import DELAY
from fleet_slip.errors import RefusedError
from fleet_slip.warehouse.database import parse_predicate
from fleet_slip.warehouse.erasure_log import ErasureLog, ErasureSubject
from fleet_slip.warehouse.gram_reader import open_grams
from tests.support.catalog import SIGNALS

CAMPAIGN = """
name = "late"
description = "Drives with receivers that are late"
base = "smoke"
drives_per_day = 4
laps = 1

[receivers]
delay_error_s = {{ min = {0}, max = {0} }}

[[receivers.types]]
name = "box"
rate_hz = 10
velocity_std_mps = 0.03
time_between_outages_s = 60.0
outage_duration_s = 5.0
"""


LateFleet = Callable[..., Fleet]


@pytest.fixture(scope="module")
def late_fleet(tmp_path_factory: pytest.TempPathFactory) -> LateFleet:
    """Return a fleet of its own in a folder: each delay is simulated once."""
    roots: dict[float, Path] = {}

    def fleet(folder: Path, delay_s: float, grams: Sequence[str] = ("delay",)) -> Fleet:
        (folder / "late.toml").write_text(CAMPAIGN.format(delay_s))
        if delay_s not in roots:
            roots[delay_s] = tmp_path_factory.mktemp("late") / "data"
            first = fleet_slip.open(roots[delay_s])
            first.simulate(str(folder / "late.toml"))
            first.gram()
        fleet_ = fleet_slip.open(shutil.copytree(roots[delay_s], folder / "data"))
        for name in grams:
            fleet_.gram(name)
        return fleet_

    return fleet


@pytest.mark.parametrize(
    "delay_s", [0.087, *(pytest.param(s, marks=pytest.mark.long) for s in (0.0, 0.3))]
)
def test_the_delay_is_found_with_its_uncertainty(
    late_fleet: LateFleet, tmp_path: Path, delay_s: float
) -> None:
    fleet = late_fleet(tmp_path, delay_s)
    fleet.gram("calibration")
    calibration = fleet.maintenance.calibrate()
    (car,), (delay,) = calibration.receivers.cars, calibration.receivers.cars.values()
    assert delay.drives == 8
    assert abs(delay.value - delay_s) < 0.005
    assert delay.uncertainty is not None
    assert 0 < delay.uncertainty < 0.005
    assert abs(delay.value - delay_s) < 3 * delay.uncertainty + 0.001
    assert calibration.as_dict()["receivers"]["cars"][car]["delay_s"] == delay.value
    assert f"its satellite receiver is late by {1000 * delay.value:.0f} +- " in str(
        [*calibration.parts(car)]
    )


def test_a_car_of_few_drives_is_as_sure_as_usual_drives_make_it() -> None:
    certain = ReceiverDelay(0.1, 0.004, 4, 9000, information=40.0, differing=3.0)
    uncertain = ReceiverDelay(0.09, None, 1, 2000, information=10_000.0, differing=0.0)
    assert with_pooled({"a": uncertain}) == {"a": uncertain}
    pooled = with_pooled({"a": uncertain, "b": certain})
    assert pooled["b"] == certain
    assert pooled["a"].uncertainty == pytest.approx(math.sqrt(1 / 10_000 + 0.003**2))


def test_the_delay_of_a_type_is_told_by_its_cars(late_fleet: LateFleet, tmp_path: Path) -> None:
    """The drives of one car stand in for those of five, of which one has had two receivers."""
    fleet = late_fleet(tmp_path, 0.087)
    predicate = parse_predicate(SIGNALS, "true")
    with open_grams(fleet.warehouse, DELAY, predicate) as opened:
        rows = pa.Table.from_batches(opened.batches(predicate)).sort_by("drive_id")
    assert rows["receiver"].unique().to_pylist() == ["box"]
    cars = pa.array(list("aabbcdee"))
    order = np.unique(rows["drive_id"].to_pylist(), return_inverse=True)[1]
    cars = cars.take(pa.array(order))
    rows = rows.set_column(rows.column_names.index("vehicle_id"), "vehicle_id", cars)
    delays = receiver_delays(rows.to_batches())
    kind = delays.types["box"]
    assert abs(kind.mean - 0.087) < 0.005
    assert kind.mean_error < 0.003
    assert kind.spread + kind.spread_error < 0.01
    assert all(abs(delay.value - 0.087) < 0.005 for delay in delays.cars.values())
    several = pa.array(["telephone" if drive == 7 else "box" for drive in order])
    rows = rows.set_column(rows.column_names.index("receiver"), "receiver", several)
    delays = receiver_delays(rows.to_batches())
    assert delays.cars["e"].receiver is None
    assert delays.cars["a"].receiver == "box"


MODEL = "steering_mean_16,ay_mean_16,ay_square_mean_8,yaw_rate_speed_mean_8"
CORRECTED = """
    SELECT drive_id, signals, course_delay_quarter_ticks, row_count, sums, products FROM grams
    WHERE feature_set LIKE 'course-%' ORDER BY ALL
"""


def corrected_rows(fleet: Fleet) -> list[tuple[Any, ...]]:
    with fleet.session(CORRECTED) as session:
        return session.sql(CORRECTED).fetchall()


@pytest.mark.long
def test_a_late_course_teaches_what_one_in_time_does(late_fleet: LateFleet, tmp_path: Path) -> None:
    """From one command: the Gram rows that tell the delay are computed by it."""
    coefficients = []
    for delay_s in (0.0, 0.187):
        (tmp_path / str(delay_s)).mkdir()
        fleet = late_fleet(tmp_path / str(delay_s), delay_s, grams=("course",))
        assert {row[2] for row in corrected_rows(fleet)} <= {
            round(delay_s / 0.0025) + off for off in (-1, 0, 1)
        }
        for name in ("calibration", "windows"):
            fleet.gram(name)
        selection = fleet.cohort("true").select(label="course", model=MODEL)
        coefficients.append([float(c) for c in selection.winner.model.model.coefficients])
        assert fleet.models.publish("in_time", selection).new
    assert coefficients[1] == pytest.approx(coefficients[0], rel=0.1)


def test_gram_rows_follow_the_delay_that_more_drives_tell(
    late_fleet: LateFleet, tmp_path: Path
) -> None:
    fleet = late_fleet(tmp_path, 0.087, grams=())
    ((first,), *_) = fleet.sql("SELECT min(day) FROM drives").fetchall()
    fleet.gram("course", cohort=f"day = '{first}'")
    early = corrected_rows(fleet)
    assert fleet.gram("course").changed
    rows = corrected_rows(fleet)
    assert len({row[2] for row in rows}) == 1
    assert len(rows) > len(early)
    assert not fleet.gram("course").changed
    assert fleet.maintenance.check_grams().wide_drives


def test_an_erased_drive_no_longer_affects_the_delay(late_fleet: LateFleet, tmp_path: Path) -> None:
    fleet = late_fleet(tmp_path, 0.087, grams=("course",))
    ((drive,), *_) = fleet.sql("SELECT min(drive_id) FROM drives").fetchall()
    fleet.maintenance.forget(drive=drive)
    rows = corrected_rows(fleet)
    assert drive not in {row[0] for row in rows}
    other = fleet_slip.open(tmp_path / "anew")
    shutil.copytree(tmp_path / "data" / "logs", tmp_path / "anew" / "logs")
    for name in ("signals", "course"):
        other.gram(name)
    assert corrected_rows(other) == rows


def test_an_erased_car_has_no_delay(late_fleet: LateFleet, tmp_path: Path) -> None:
    warehouse = late_fleet(tmp_path, 0.087).warehouse
    grams = warehouse.grams.snapshot()
    active = frozenset(file.path for file in warehouse.logs.snapshot().files)
    (car,) = course_delays(warehouse, grams, active)
    ErasureLog(warehouse.root).begin(ErasureSubject("vehicle", car), 1, [])
    assert not course_delays(warehouse, grams, active)


def test_a_model_of_a_course_with_unknown_delay_is_not_published(
    late_fleet: LateFleet, tmp_path: Path
) -> None:
    fleet = late_fleet(tmp_path, 0.087, grams=("calibration",))
    drives = [drive for (drive,) in fleet.sql("SELECT drive_id FROM drives").fetchall()]
    predicate = f"drive_id <= '{sorted(drives)[1]}'"
    for name in ("course", "windows"):
        fleet.gram(name, cohort=predicate)
    selection = fleet.cohort(predicate).select(label="course", model="steering_mean_16,ay_mean_16")
    with pytest.raises(RefusedError, match=r"too uncertain \(late-0000: \d\d ms, from too few"):
        fleet.models.publish("late", selection)
    assert fleet.models.publish("late", selection, force=True).new


def test_one_wild_car_leaves_the_delays_of_the_others_known() -> None:
    tame = {
        f"car-{number}": ReceiverDelay(0.1, None, 2, 2000, information=40.0, differing=1.0)
        for number in range(99)
    }
    wild = ReceiverDelay(0.5, None, 2, 2000, information=40.0, differing=1e9)
    assert with_pooled(tame | {"wild": wild})["car-0"] == with_pooled(tame)["car-0"]
