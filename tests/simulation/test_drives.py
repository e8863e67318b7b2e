"""From drives to rows: the table's shape, and that its bytes depend on the batch alone."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import date

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from numpy.typing import NDArray

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.simulation import job as simulate
from fleet_slip.simulation.campaign import Batch, DriveSpec, load_campaign
from fleet_slip.simulation.job import DriveLog, simulate_batch, simulate_logs, tabulate
from fleet_slip.simulation.roads import load_track
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.batch_kernel import BLOCK, CHANNELS
from tests.support.logs import schema_without
from tests.support.measuring import measure

DAY = date(2024, 5, 1)


def short_batch(laps: float = 0.05) -> Batch:
    """Return the four drives of a smoke day, a few seconds each."""
    drives = load_campaign("smoke").drives(DAY)
    return Batch("smoke", DAY, 0, tuple(replace(drive, laps=laps) for drive in drives))


Truth = dict[str, NDArray[np.float64]]


def synthetic_truth(ticks: int) -> Truth:
    return {name: np.full(ticks, 0.01 * (i + 1)) for i, name in enumerate(CHANNELS)}


def synthetic_table(*truths: Truth, lost_control_s: float | None = None) -> pa.Table:
    """Return the rows of drives; the last one is lost."""
    batch = short_batch()
    lost = [None] * (len(truths) - 1) + [lost_control_s]
    logs = [
        DriveLog(spec, measure(truth, spec.sensors, spec.generator()), at_s)
        for spec, truth, at_s in zip(batch.drives, truths, lost, strict=False)
    ]
    return tabulate(batch, logs)


def physical(table: pa.Table, name: str) -> NDArray[np.float64]:
    counts: NDArray[np.float64] = table[name].to_numpy().astype(np.float64)
    return counts * float(catalogue()[name].scale)


def test_table_has_the_schema_of_the_logs_with_strings_as_dictionaries() -> None:
    table = synthetic_table(synthetic_truth(30), synthetic_truth(20))
    plain = [
        field.with_type(field.type.value_type) if pa.types.is_dictionary(field.type) else field
        for field in table.schema
    ]
    assert pa.schema(plain) == schema_without(catalogue().optional)
    table.validate(full=True)


def test_drive_columns_say_what_was_driven() -> None:
    spec = short_batch().drives[1]
    row = synthetic_table(synthetic_truth(3), synthetic_truth(2), lost_control_s=0.01).to_pylist()[
        -1
    ]
    expected = {
        "drive_id": spec.drive_id,
        "vehicle_id": "smoke-0000",
        "vehicle_model": "d_class_sedan",
        "source": "simulated",
        "campaign": "smoke",
        "track": "waterford_hills",
        "mass_kg": 1320.0,
        "adhesion": 1.0,
        "speed_factor": spec.speed_factor,
        "duration_s": 0.01,
        "rows": 2,
        "lost_control_s": 0.01,
        "saturated": 0,
    }
    assert {name: row[name] for name in expected} == expected
    assert [*expected] == [n for n in catalogue().drive if n not in catalogue().optional]


def test_only_gps_between_fixes_is_null() -> None:
    table = synthetic_table(synthetic_truth(30), synthetic_truth(20))
    for name in set(catalogue().signals) - set(catalogue().extras):
        is_fix = [tick % 10 == 0 for tick in table["tick"].to_pylist()]
        expected = is_fix if name.startswith("gps_") else [True] * 50
        assert table[name].is_valid().to_pylist() == expected, name


def test_clipped_values_are_counted_in_every_row_of_their_drive() -> None:
    truth = synthetic_truth(12)
    truth["ay_mps2"][3:5] = 99.0
    table = synthetic_table(synthetic_truth(30), truth)
    assert table["saturated"].to_pylist() == [0] * 30 + [2] * 12
    assert table["ay"].to_pylist()[33:35] == [30000, 30000]


@pytest.mark.parametrize("together", [1, 3])
def test_bytes_do_not_depend_on_which_drives_run_side_by_side(
    together: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = simulate_batch(short_batch())
    monkeypatch.setattr(simulate, "DRIVES_AT_ONCE", together)
    assert simulate_batch(short_batch()).equals(expected)


def test_bytes_do_not_depend_on_threads_or_on_the_order_of_batches() -> None:
    whole = short_batch()
    batches = [Batch("smoke", DAY, i, (drive,)) for i, drive in enumerate(whole.drives)]
    one_by_one = [simulate_batch(batch) for batch in batches]
    with ThreadPoolExecutor(4) as threads:
        backwards = list(threads.map(simulate_batch, reversed(batches)))
    for here, there in zip(one_by_one, reversed(backwards), strict=True):
        assert here.equals(there)
    unified = pa.concat_tables(one_by_one).unify_dictionaries().combine_chunks()
    assert unified.equals(simulate_batch(whole))


def test_drives_last_as_long_as_expected() -> None:
    batch = short_batch(laps=0.3)
    rows = pc.value_counts(simulate_batch(batch)["drive_id"].cast(pa.string())).to_pylist()
    for spec, count in zip(batch.drives, rows, strict=True):
        assert count["values"] == spec.drive_id
        assert count["counts"] == pytest.approx(spec.expected_rows, rel=0.05)


def on_skid_pad(drive: DriveSpec, lateral_mps2: float) -> DriveSpec:
    limits = drive.limits.model_copy(update={"lateral_mps2": lateral_mps2})
    return replace(drive, track=load_track("skid_pad"), limits=limits, speed_factor=1.0, laps=1.0)


def test_left_turn_has_positive_yaw_rate_lateral_acceleration_and_steer() -> None:
    drive = on_skid_pad(short_batch().drives[0], 4.0)
    table = simulate_batch(Batch("test", DAY, 0, (drive,)))
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
    (drive, *_) = load_campaign("smoke").drives(date(2024, 5, 1))
    empty = on_skid_pad(drive, 0.3)
    body = empty.vehicle.body
    car = empty.vehicle.with_sprung_mass(body.sprung_mass_kg + 300, -1.9)
    shift_m = 300 * 1.9 / (body.mass_kg + 300)
    assert car.body.reference_m == pytest.approx(shift_m)
    logs = simulate_logs([empty, replace(empty, vehicle=car)], ("vy_mps", "vx_mps"))
    one, other = (np.mean(log.motion["vy_mps"][500:] / log.motion["vx_mps"][500:]) for log in logs)
    radius_m = 1 / float(np.mean(empty.profile.track.curvature(empty.profile.station_m)))
    assert one == pytest.approx(body.rear_axle_m / radius_m, abs=0.002)
    assert other == pytest.approx(one, abs=0.1 * shift_m / radius_m)
    label = catalogue()["sideslip"]
    for log, expected in zip(logs, (one, other), strict=True):
        measured = np.mean(log.measurement.counts["sideslip"][500:]) * float(label.scale)
        assert measured == pytest.approx(expected, abs=0.0005)


def test_a_drive_longer_than_a_block_goes_on_where_the_block_ended() -> None:
    drive = on_skid_pad(short_batch().drives[0], 4.0)
    long = replace(drive, laps=2 * BLOCK / drive.expected_rows * 1.1)
    log, short = simulate_logs([long, replace(drive, laps=0.5)])
    assert log.rows > 2 * BLOCK
    table = tabulate(Batch("test", DAY, 0, (long, drive)), [log, short])
    assert table["tick"].to_pylist() == [*range(log.rows), *range(short.rows)]
    for name in ("vx", "station", "yaw_rate"):
        counts = log.measurement.counts[name].astype(int)
        steps = np.abs(np.diff(counts[BLOCK // 2 :]))
        at_border = steps[BLOCK // 2 - 1 :: BLOCK]
        assert at_border.max() <= np.sort(steps)[-len(steps) // 1000], name
    fixes = np.flatnonzero(log.measurement.gps_fix)
    assert np.all(fixes % 10 == 0)
    assert fixes[-1] > 2 * BLOCK
