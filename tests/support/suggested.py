"""Logs of a car by the textbook, as other programs write them, and the mapping that is right."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import cantools
import mcap_ros2.writer
import numpy as np
import polars as pl
import scipy.io
from asammdf import MDF, Signal

from fleet_slip.ingest.columns import SignalColumn
from fleet_slip.ingest.draft import Draft, draft_mapping, signal_keys
from fleet_slip.ingest.formats.can import CanBus
from fleet_slip.ingest.profile import profile_file
from fleet_slip.ingest.suspicion import RADIUS_M, WHEELS
from tests.support.textbook_car import Car, a_car

G_MPS2 = 9.80665
DEGREES = dict.fromkeys(("yaw_rate", "steering_wheel", "sideslip"), 180 / np.pi)
KMH = dict.fromkeys(WHEELS, 3.6 * RADIUS_M)
_SI = {"ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s", "steering_wheel": "rad"}
SI_UNITS = {**_SI, **dict.fromkeys(WHEELS, "rad/s"), "sideslip": "rad"}
ENGLISH = {
    "ax": "LongAcc", "ay": "LatAcc_obd", "yaw_rate": "YawRate", "steering_wheel": "SW_pos",
    "wheel_fl": "VelFL", "wheel_fr": "VelFR", "wheel_rl": "VelRL", "wheel_rr": "VelRR",
    "sideslip": "Correvit_slip_angle",
}  # fmt: skip
ROS = {
    "ax": "/imu/data.linear_acceleration.x", "ay": "/imu/data.linear_acceleration.y",
    "yaw_rate": "/imu/data.angular_velocity.z", "steering_wheel": "/car.steering_wheel_angle",
    "wheel_fl": "/car.wheel_speed_fl", "wheel_fr": "/car.wheel_speed_fr",
    "wheel_rl": "/car.wheel_speed_rl", "wheel_rr": "/car.wheel_speed_rr", "sideslip": "/car.beta",
}  # fmt: skip
DBC = """VERSION ""
BU_: ECU
BO_ 256 ESP: 8 ECU
 SG_ AccelLong : 0|16@1- (0.001,0) [0|0] "g" ECU
 SG_ AccelLat : 16|16@1- (0.001,0) [0|0] "g" ECU
 SG_ YawRate : 32|16@1- (0.01,0) [0|0] "deg/s" ECU
 SG_ SteeringWheelAngle : 48|16@1- (0.1,0) [0|0] "deg" ECU
BO_ 257 ABS: 8 ECU
 SG_ WheelSpeedFL : 0|16@1+ (0.01,0) [0|0] "km/h" ECU
 SG_ WheelSpeedFR : 16|16@1+ (0.01,0) [0|0] "km/h" ECU
 SG_ WheelSpeedRL : 32|16@1+ (0.01,0) [0|0] "km/h" ECU
 SG_ WheelSpeedRR : 48|16@1+ (0.01,0) [0|0] "km/h" ECU
BO_ 258 Correvit: 8 ECU
 SG_ SlipAngle : 0|16@1- (0.01,0) [0|0] "deg" ECU
"""
ON_BUS = {
    "ax": "ESP.AccelLong", "ay": "ESP.AccelLat", "yaw_rate": "ESP.YawRate",
    "steering_wheel": "ESP.SteeringWheelAngle", "wheel_fl": "ABS.WheelSpeedFL",
    "wheel_fr": "ABS.WheelSpeedFR", "wheel_rl": "ABS.WheelSpeedRL", "wheel_rr": "ABS.WheelSpeedRR",
    "sideslip": "Correvit.SlipAngle",
}  # fmt: skip
_BUS_FACTORS = {"ax": 1 / G_MPS2, "ay": 1 / G_MPS2, **DEGREES, **KMH}
BUS = CanBus(database="car.dbc", text=DBC)


def _columns(car: Car, names: Mapping[str, str], factors: Mapping[str, float]) -> pl.DataFrame:
    time = pl.Series("t", np.arange(len(car["ax"])) / 100)
    values = {names[n]: v * factors.get(n, 1.0) for n, v in car.items()}
    return pl.DataFrame({"t": time, **values})


def _csv(names: Mapping[str, str], factors: Mapping[str, float]) -> Callable[[Path, Car], None]:
    return lambda file, car: _columns(car, names, factors).write_csv(file)


def _mdf(file: Path, car: Car) -> None:
    told = {"ax": ("g", 1 / G_MPS2), "ay": ("g", 1 / G_MPS2)}
    told |= {name: (f"°{'/s' * (name == 'yaw_rate')}", 180 / np.pi) for name in DEGREES}
    with MDF(version="4.10") as mdf:
        for name, values in car.items():
            unit, factor = told.get(name, ("rad/s", 1.0))
            step = 10 if name == "sideslip" else 1
            time_s = np.arange(0, len(values), step) / 100
            mdf.append([Signal(values[::step] * factor, time_s, name=ENGLISH[name], unit=unit)])
        mdf.save(file)


def _matlab(file: Path, car: Car) -> None:
    columns = _columns(car, {n: n for n in car}, DEGREES).to_dict(as_series=False)
    scipy.io.savemat(file, {"Data": {name: np.array(v) for name, v in columns.items()}})


def _frames(trace: can.Listener, car: Car) -> None:
    database: Any = cantools.database.load_string(DBC, "dbc")
    for message in database.messages:
        signals = {
            n: column.partition(".")[2]
            for n, column in ON_BUS.items()
            if column.startswith(f"{message.name}.")
        }
        for i in range(len(car["ax"])):
            values = {s: car[n][i] * _BUS_FACTORS[n] for n, s in signals.items()}
            frame = can.Message(
                1717156800 + i / 100,
                arbitration_id=message.frame_id,
                is_extended_id=False,
                data=message.encode(values),
                channel=1,
            )
            trace.on_message_received(frame)


def _blf(file: Path, car: Car) -> None:
    with can.BLFWriter(file) as trace:
        _frames(trace, {name: values[:1200] for name, values in car.items()})


def _mcap(file: Path, car: Car) -> None:
    fields = [ROS[n].partition(".")[2] for n in ROS if ROS[n].startswith("/car.")]
    vector = f"{'=' * 80}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    imu = "geometry_msgs/Vector3 angular_velocity\ngeometry_msgs/Vector3 linear_acceleration\n"
    with file.open("wb") as stream:
        writer = mcap_ros2.writer.Writer(stream)
        of_imu = writer.register_msgdef("sensor_msgs/Imu", imu + vector)
        of_car = writer.register_msgdef("car/State", "\n".join(f"float64 {f}" for f in fields))
        for i in range(1200):
            now = round((1717156800 + i / 100) * 1e9)
            turning = {"x": 0.0, "y": 0.0, "z": float(car["yaw_rate"][i])}
            moving = {"x": float(car["ax"][i]), "y": float(car["ay"][i]), "z": 9.81}
            both = {"angular_velocity": turning, "linear_acceleration": moving}
            writer.write_message("/imu/data", of_imu, both, now, now)
            names = {c.partition(".")[2]: n for n, c in ROS.items() if c.startswith("/car.")}
            state = {field: float(car[names[field]][i]) for field in fields}
            writer.write_message("/car", of_car, state, now, now)
        writer.finish()  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class Suggested:
    """A log, and what is right of it.

    Attributes:
        names: column of each signal.
        factors: value in the file of one SI unit.
        bus: the database of a CAN trace.
    """

    suffix: str
    write: Callable[[Path, Car], None]
    names: Mapping[str, str]
    factors: Mapping[str, float]
    bus: CanBus | None = None


LOGS: dict[str, Suggested] = {
    "CSV, names of a race team, km/h and degrees": Suggested(
        ".csv", _csv(ENGLISH, {**DEGREES, **KMH}), ENGLISH, {**DEGREES, **KMH}
    ),
    "MDF 4, g and degrees, a label of 10 Hz": Suggested(
        ".mf4", _mdf, ENGLISH, {"ax": 1 / G_MPS2, "ay": 1 / G_MPS2, **DEGREES}
    ),
    "MATLAB, a struct with the catalogue's names": Suggested(
        ".mat", _matlab, {name: f"Data.{name}" for name in ENGLISH}, DEGREES
    ),
    "CAN trace (BLF) with a DBC": Suggested(".blf", _blf, ON_BUS, _BUS_FACTORS, bus=BUS),
    "MCAP, sensor_msgs/Imu and a message of the car": Suggested(".mcap", _mcap, ROS, {}),
}


def suggest(one: Suggested, folder: Path) -> Draft:
    """Write a log, and return the draft of its mapping."""
    file = folder / f"log{one.suffix}"
    one.write(file, a_car())
    return draft_mapping(file, profile_file(file, one.bus))


def filled_in(draft: str) -> str:
    """Return a draft with a day and a car, where it asks for them."""
    for line in ("day = 2024-05-31  #", 'vehicle_id = ""', 'vehicle_model = ""'):
        draft = draft.replace(f"# {line}", line.replace('""', '"A7"'))
    return draft


def with_first_units(draft: str) -> str:
    """Return a draft with the first of the units that it asks for."""
    asked = re.compile(
        r'# Choose the unit: "(.+?)"( with ([^ ]+ = [^ ]+))?( or .*)?\.\n(.*)"choose"'
    )
    return asked.sub(lambda m: f'{m[5]}"{m[1]}"' + (f", {m[3]}" if m[3] else ""), draft)


def wrong_guesses(one: Suggested, draft: Draft) -> list[str]:
    """Return the signals of which column, unit or sign is not right, absent ones included."""
    return [name for name in one.names if not _is_right(one, draft, name)]


def _is_right(one: Suggested, draft: Draft, name: str) -> bool:
    if name not in draft.guesses:
        return False
    guess, expected = draft.guesses[name], 1 / one.factors.get(name, 1.0)
    for reading in guess.readings or ({},):  # one of those that it asks for
        keys = {**signal_keys(guess), **reading}
        keys.pop("longest_gap_s", None)
        gain, _ = SignalColumn.model_validate(keys).linear(SI_UNITS[name])
        if keys["column"] == one.names[name] and np.isclose(gain, expected, rtol=1e-3):
            return True
    return False
