"""Trials on a proving ground and on roads: what is drawn, what manoeuvres make of a drive."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import date
from functools import partial

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from fleet_slip.errors import ConfigError
from fleet_slip.evaluation.evaluated_drives import blind_scenarios
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Batch, DriveSpec, load_campaign
from fleet_slip.simulation.roads import SLOWEST_MPS, Manoeuvre, load_track, road_with
from fleet_slip.simulation.scenario import load_scenarios
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.simulation.simulate import DriveLog, simulate_batch, simulate_logs, tabulate
from fleet_slip.vehicle.batch import CHANNELS, LaneDrive, Road
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.catalog import SIGNALS
from tests.support.logs import schema_without
from tests.support.measurements import measure
from tests.support.rolling import simulate_drives

SEDAN = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)


@pytest.fixture(scope="module")
def drives() -> tuple[DriveSpec, ...]:
    campaign = load_campaign("proving_ground", SHIPPED_CONFIGS)
    return tuple(drive for day in campaign.days() for drive in campaign.drives(day))


def straight(speed_mps: float = 20.0, *, closed: bool = False) -> Road:
    entries = 600 if closed else 601
    return Road(1.0, np.zeros(entries), np.full(entries, speed_mps), 600.0, closed)


def test_no_drive_of_a_scenario_is_driven(drives: tuple[DriveSpec, ...]) -> None:
    tests = [scenario.batch().drives[0] for scenario in load_scenarios(SHIPPED_CONFIGS)]
    assert {d.seed for d in drives}.isdisjoint(d.seed for d in tests)
    plans = {(d.vehicle, d.track.name, d.limits, d.adhesion) for d in drives}
    assert plans.isdisjoint((d.vehicle, d.track.name, d.limits, d.adhesion) for d in tests)


def test_a_step_turns_to_its_side_and_back() -> None:
    road = road_with(straight(), [Manoeuvre("step", 100.0, 2.0, 3.0, 1.0)])
    assert road.curvature_1pm[99] == 0.0
    assert road.curvature_1pm[100:120] == pytest.approx(3.0 / 400)
    assert road.curvature_1pm[120:140] == pytest.approx(-3.0 / 400)
    assert road.curvature_1pm[140:] == pytest.approx(0.0)
    assert road.speed_mps == pytest.approx(20.0)


def test_a_slalom_swings_once_a_period_and_ends_where_it_began() -> None:
    road = road_with(straight(), [Manoeuvre("slalom", 100.0, 4.0, 2.0, 2.0)])
    swing = road.curvature_1pm[100:180]
    assert np.abs(swing).max() == pytest.approx(2.0 / 400)
    assert swing.sum() == pytest.approx(0.0, abs=1e-12)
    assert int((np.diff(np.sign(swing[1:])) < 0).sum()) == 2


def test_braking_slows_down_as_hard_as_it_says_and_never_to_a_stop() -> None:
    road = road_with(straight(), [Manoeuvre("braking", 100.0, 2.0, -3.0, 1.0)])
    assert road.speed_mps.min() == pytest.approx(20.0 - 3.0)
    assert road.speed_mps[100] == pytest.approx(20.0)
    slow = road_with(straight(5.0), [Manoeuvre("braking", 100.0, 9.0, 9.0, 1.0)])
    assert slow.speed_mps.min() == SLOWEST_MPS


def test_a_manoeuvre_goes_on_over_the_start_of_a_closed_road_and_not_of_an_open_one() -> None:
    script = [Manoeuvre("step", 590.0, 2.0, 3.0, 1.0)]
    assert road_with(straight(closed=True), script).curvature_1pm[:5] == pytest.approx(3.0 / 400)
    assert road_with(straight(), script).curvature_1pm[:5] == pytest.approx(0.0)


def test_a_car_drives_the_lateral_acceleration_of_a_slalom() -> None:
    road = road_with(straight(), [Manoeuvre("slalom", 200.0, 8.0, 2.0, 4.0)])
    (plain, swung) = simulate_drives([LaneDrive(SEDAN, r, 1.0, 1.0) for r in (straight(), road)])
    assert np.abs(plain.ay_mps2).max() < 0.01
    assert 1.6 < np.abs(swung.ay_mps2).max() < 2.8
    assert swung.lost_control_tick is None


def test_no_road_of_the_plan_is_a_blind_one() -> None:
    """Names reach to nine digits; a version's seeds are below that once in 10⁹ versions."""
    with pytest.raises(ConfigError):
        load_track("country_1000000000", SHIPPED_CONFIGS)
    assert min(scenario.seed for scenario in blind_scenarios("ab" * 32, SHIPPED_CONFIGS)) > 1e9
    assert (
        load_campaign("proving_roads", SHIPPED_CONFIGS).seed
        != load_campaign("proving_ground", SHIPPED_CONFIGS).seed
    )


DAY = date(2024, 5, 1)


def short_batch(laps: float = 0.05) -> Batch:
    """Return the four drives of a smoke day, a few seconds each."""
    drives = load_campaign("smoke", SHIPPED_CONFIGS).drives(DAY)
    return Batch("smoke", DAY, 0, tuple(replace(drive, laps=laps) for drive in drives))


Truth = dict[str, NDArray[np.float64]]


def synthetic_truth(ticks: int) -> Truth:
    return {name: np.full(ticks, 0.01 * (i + 1)) for i, name in enumerate(CHANNELS)}


def synthetic_table(*truths: Truth, lost_control_s: float | None = None) -> pa.Table:
    """Return the rows of drives; the last one is lost."""
    batch = short_batch()
    lost = [None] * (len(truths) - 1) + [lost_control_s]
    logs = [
        DriveLog(spec, measure(truth, spec.sensors, spec.generator("sensors")), at_s)
        for spec, truth, at_s in zip(batch.drives, truths, lost, strict=False)
    ]
    return tabulate(SIGNALS, batch, logs)


def physical(table: pa.Table, name: str) -> NDArray[np.float64]:
    counts: NDArray[np.float64] = table[name].to_numpy().astype(np.float64)
    return counts * float(SIGNALS[name].scale)


def test_table_has_the_schema_of_the_logs_with_strings_as_dictionaries() -> None:
    table = synthetic_table(synthetic_truth(30), synthetic_truth(20))
    plain = [
        field.with_type(field.type.value_type) if pa.types.is_dictionary(field.type) else field
        for field in table.schema
    ]
    assert pa.schema(plain) == schema_without(SIGNALS.optional)
    table.validate(full=True)


def test_only_gps_between_fixes_is_null() -> None:
    table = synthetic_table(synthetic_truth(30), synthetic_truth(20))
    for name in set(SIGNALS.signals) - set(SIGNALS.extras):
        is_fix = [tick % 10 == 0 for tick in table["tick"].to_pylist()]
        expected = is_fix if name.startswith("gps_") else [True] * 50
        assert table[name].is_valid().to_pylist() == expected, name


def test_clipped_values_are_counted_in_every_row_of_their_drive() -> None:
    truth = synthetic_truth(12)
    truth["ay_mps2"][3:5] = 99.0
    table = synthetic_table(synthetic_truth(30), truth)
    assert table["saturated"].to_pylist() == [0] * 30 + [2] * 12
    assert table["ay"].to_pylist()[33:35] == [30000, 30000]


def test_bytes_do_not_depend_on_threads_or_on_the_order_of_batches() -> None:
    expected = short_batch()
    batches = [Batch("smoke", DAY, i, (drive,)) for i, drive in enumerate(expected.drives)]
    one_by_one = [simulate_batch(SIGNALS, batch) for batch in batches]
    with ThreadPoolExecutor(4) as threads:
        backwards = list(threads.map(partial(simulate_batch, SIGNALS), reversed(batches)))
    for forward, backward in zip(one_by_one, reversed(backwards), strict=True):
        assert forward.equals(backward)
    unified = pa.concat_tables(one_by_one).unify_dictionaries().combine_chunks()
    assert unified.equals(simulate_batch(SIGNALS, expected))


def on_skid_pad(drive: DriveSpec, lateral_mps2: float) -> DriveSpec:
    limits = drive.limits.model_copy(update={"lateral_mps2": lateral_mps2})
    return replace(
        drive,
        track=load_track("skid_pad", SHIPPED_CONFIGS),
        limits=limits,
        speed_factor=1.0,
        laps=1.0,
    )


def test_left_turn_has_positive_yaw_rate_lateral_acceleration_and_steer() -> None:
    drive = on_skid_pad(short_batch().drives[0], 4.0)
    table = simulate_batch(SIGNALS, Batch("test", DAY, 0, (drive,)))
    steady = table.slice(5 * SAMPLE_RATE_HZ)
    speed = np.sqrt(4.0 * 50.0)
    assert np.mean(physical(steady, "ay")) == pytest.approx(4.0 + 0.15, abs=0.1)
    assert np.mean(physical(steady, "yaw_rate")) == pytest.approx(speed / 50.0 + 0.01, rel=0.02)
    assert np.mean(physical(steady, "vx")) == pytest.approx(speed, rel=0.02)
    for name in ("steering_wheel", "steer_fl", "steer_fr"):
        assert physical(steady, name).min() > 0, name
    assert np.mean(physical(steady, "wheel_fr")) > np.mean(physical(steady, "wheel_fl"))
    beta = np.arctan2(physical(steady, "vy"), physical(steady, "vx"))
    assert np.allclose(physical(steady, "sideslip"), beta, atol=0.005)


def test_the_angle_of_a_loaded_car_is_that_of_the_place_where_the_empty_one_has_it() -> None:
    """Slowly round a circle the rear wheels roll: the angle is their distance over the radius.

    300 kg, 1.9 m behind, move the centre of gravity by a third of a metre, and 0.6 degrees.
    """
    (drive, *_) = load_campaign("smoke", SHIPPED_CONFIGS).drives(date(2024, 5, 1))
    empty = on_skid_pad(drive, 0.3)
    body = empty.vehicle.body
    car = empty.vehicle.with_sprung_mass(body.sprung_mass_kg + 300, -1.9)
    shift_m = 300 * 1.9 / (body.mass_kg + 300)
    assert car.body.reference_m == pytest.approx(shift_m)
    logs = simulate_logs(SIGNALS, [empty, replace(empty, vehicle=car)], ("vy_mps", "vx_mps"))
    loaded, other = (
        np.mean(log.motion["vy_mps"][500:] / log.motion["vx_mps"][500:]) for log in logs
    )
    radius_m = 1 / float(np.mean(empty.profile.track.curvature(empty.profile.station_m)))
    assert loaded == pytest.approx(body.rear_axle_m / radius_m, abs=0.002)
    assert other == pytest.approx(loaded, abs=0.1 * shift_m / radius_m)
    label = SIGNALS["sideslip"]
    for log, expected in zip(logs, (loaded, other), strict=True):
        measured = np.mean(log.measurement.counts["sideslip"][500:]) * float(label.scale)
        assert measured == pytest.approx(expected, abs=0.0005)
