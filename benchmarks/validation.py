"""The simulated cars in the manoeuvres of ISO 4138, 7401 and 3888, beside closed forms.

    python -m benchmarks.validation [--plots docs/images] [--document docs/vehicle.md]

Compact, sedan and SUV, each as its file has it and as a car with the imperfections of the scenario
`imperfect`. The closed forms are those of the linear bicycle (Riekert and Schunck 1940; here as in
Rajamani 2012, chapter 2): yaw gain, characteristic speed, natural frequency, damping, and the
response to a step of the steering.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

from benchmarks.harness import insert
from fleet_slip.arrays import FloatArray
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.vehicle.batch import LaneDrive, Road
from fleet_slip.vehicle.driver import handling
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    PERFECT,
    CarImperfections,
    VehicleParameters,
    load_vehicle,
)
from tests.support.linear_bicycle import LinearBicycle, Response, steer
from tests.support.rolling import Truth, simulate_drives

CARS = {"compact": "compact_hatchback", "sedan": "d_class_sedan", "SUV": "suv"}
RADIUS_M = 100.0
STEP_SPEED_MPS = 80 / 3.6
STEP_AY_MPS2 = 4.0
STEER_RATE_RAD_S = np.radians(500)
CAR_WIDTH_M = 1.8


def imperfections() -> CarImperfections:
    """Return the imperfections of a car of the scenario `imperfect`."""
    return load_scenario("imperfect", SHIPPED_CONFIGS).imperfections.car


def compliance(flaws: CarImperfections) -> float:
    """Return the compliance of the steering in rad/N."""
    return float(np.radians(flaws.steering_compliance_deg_per_kn)) / 1000


@dataclass(frozen=True)
class Circle:
    """Steady states on a circle, ISO 4138 method 1: arrays over speed."""

    ay_mps2: FloatArray
    steering_deg: FloatArray
    """Steering wheel angle over the ratio."""
    sideslip_deg: FloatArray

    @property
    def understeer_deg_per_g(self) -> float:
        """Slope of the steering angle between 1 and 4 m/s²."""
        linear = (self.ay_mps2 > 1) & (self.ay_mps2 < 4)
        return float(
            np.polyfit(self.ay_mps2[linear], self.steering_deg[linear], 1)[0] * GRAVITY_MPS2
        )

    @property
    def sideslip_deg_per_g(self) -> float:
        """Slope of the side-slip angle between 1 and 4 m/s²."""
        linear = (self.ay_mps2 > 1) & (self.ay_mps2 < 4)
        return float(
            np.polyfit(self.ay_mps2[linear], self.sideslip_deg[linear], 1)[0] * GRAVITY_MPS2
        )

    @property
    def largest_ay_mps2(self) -> float:
        """Lateral acceleration at the highest speed at which the car stays on its circle."""
        return float(self.ay_mps2[-1])


def constant_radius(car: VehicleParameters, flaws: CarImperfections = PERFECT) -> Circle:
    """Drive a circle of 100 m at ever higher speeds, until the car leaves it by more than 2 m."""
    speeds = np.sqrt(RADIUS_M * np.arange(0.5, 10.6, 0.25))
    entries = round(2 * np.pi * RADIUS_M)
    ones = np.ones(entries)
    drives = [
        LaneDrive(
            car,
            Road(
                2 * np.pi * RADIUS_M / entries,
                ones / RADIUS_M,
                ones * speed,
                2 * np.pi * RADIUS_M,
                True,
            ),
            1.0,
            min(1.0, 14 * speed / (2 * np.pi * RADIUS_M)),
            flaws,
        )
        for speed in speeds
    ]
    steady = []
    for truth in simulate_drives(drives):
        end = slice(-300, None)
        if truth.lost_control_tick is not None or np.abs(truth.lateral_offset_m[end]).max() > 2:
            break
        steady.append(
            [
                truth.ay_mps2[end].mean(),
                np.degrees(truth.steering_wheel_rad[end].mean()) / car.steering.ratio,
                np.degrees(truth.sideslip_rad[end].mean()),
            ]
        )
    return Circle(*np.array(steady).T)


@dataclass(frozen=True)
class Step:
    """Response to a step of the steering wheel, ISO 7401: times from half of the steering on."""

    response: Response
    steady_yaw_rate_rad_s: float
    response_time_s: float
    """Until 90 % of the steady yaw rate."""
    peak_time_s: float
    overshoot: float
    """Highest yaw rate over the steady one, less one."""


def step_steer(
    car: VehicleParameters,
    flaws: CarImperfections = PERFECT,
    ay_mps2: float = STEP_AY_MPS2,
    speed_mps: float = STEP_SPEED_MPS,
) -> Step:
    """Turn the steering wheel at 500 °/s so far that the car settles at a lateral acceleration."""
    bicycle = LinearBicycle.from_car(car, speed_mps, compliance(flaws))
    angle = car.steering.ratio * bicycle.wheelbase_m
    angle = angle * ay_mps2 / speed_mps**2 + flaws.steering_lash_deg * np.pi / 360
    for _ in range(6):  # to the angle that gives the acceleration
        response = _turned_to(car, flaws, float(angle), speed_mps)
        angle *= ay_mps2 / response.ay_mps2[-100:].mean()
    response = _turned_to(car, flaws, float(angle), speed_mps)
    half = int(np.argmax(response.demand_rad >= angle / 2))
    rate = response.yaw_rate_rad_s
    steady = float(rate[-100:].mean())
    peak = int(np.argmax(rate))
    return Step(
        response,
        steady,
        float(response.time_s[np.argmax(rate >= 0.9 * steady)] - response.time_s[half]),
        float(response.time_s[peak] - response.time_s[half]),
        float(rate[peak] / steady - 1),
    )


def _turned_to(
    car: VehicleParameters, flaws: CarImperfections, angle: float, speed_mps: float
) -> Response:
    time_s = np.arange(0.0, 5.0, 0.01)
    demand = np.clip(STEER_RATE_RAD_S * (time_s - 0.5), 0.0, angle)
    return steer(car, flaws, demand, speed_mps)


LANE_CHANGE_M = 3.5
SECTIONS_M = (15.0, 30.0, 25.0, 25.0, 15.0, 15.0)
"""Lengths of the sections of ISO 3888-1: lane, change, other lane, change back, lane, end."""


def double_lane_change(
    car: VehicleParameters, speed_mps: float, flaws: CarImperfections = PERFECT
) -> Truth:
    """Follow the middle of the lanes of ISO 3888-1, joined by quintics, at a speed."""
    station = np.arange(0.0, 201.0)
    bounds = 50.0 + np.cumsum((0.0, *SECTIONS_M))
    out = (station - bounds[1]) / SECTIONS_M[1]
    back = (station - bounds[3]) / SECTIONS_M[3]
    bend = LANE_CHANGE_M * (
        _quintic_bend(out) / SECTIONS_M[1] ** 2 - _quintic_bend(back) / SECTIONS_M[3] ** 2
    )
    road = Road(1.0, bend, np.full(len(station), speed_mps), 200.0, False)
    (truth,) = simulate_drives([LaneDrive(car, road, 1.0, 1.0, flaws)])
    return truth


def _quintic_bend(share: FloatArray) -> FloatArray:
    """Return the second derivative of the smooth step 10 u³ − 15 u⁴ + 6 u⁵, 0 outside [0, 1]."""
    inside = (share > 0) & (share < 1)
    return np.where(inside, 60 * share - 180 * share**2 + 120 * share**3, 0.0)


def highest_speed_kmh(car: VehicleParameters, flaws: CarImperfections = PERFECT) -> int:
    """Return the highest speed at which the body stays between the cones of ISO 3888-1.

    The lanes are 1.1, 1.2 and 1.3 widths of the car and 0.25 m wide.
    """
    best = 0
    for speed_kmh in range(40, 121, 2):
        truth = double_lane_change(car, speed_kmh / 3.6, flaws)
        if truth.lost_control_tick is not None or not _within(truth):
            break
        best = speed_kmh
    return best


def _within(truth: Truth) -> bool:
    bounds = 50.0 + np.cumsum((0.0, *SECTIONS_M))
    margins = {0: 0.1, 2: 0.2, 4: 0.3}
    for section, share in margins.items():
        inside = (truth.station_m >= bounds[section]) & (truth.station_m <= bounds[section + 1])
        if np.abs(truth.lateral_offset_m[inside]).max() > (share * CAR_WIDTH_M + 0.25) / 2:
            return False
    return True


HEADER = (
    *("", "understeer gradient, °/g", "characteristic speed, km/h", "side-slip gradient, °/g"),
    *("largest ay, m/s²", "yaw frequency, Hz", "damping", "yaw response, s", "peak, s"),
    *("overshoot, %", "lane change, km/h"),
)


def row(name: str, car: VehicleParameters, flaws: CarImperfections) -> tuple[str, ...]:
    """Return what is measured of one car, as text."""
    circle, step = constant_radius(car, flaws), step_steer(car, flaws)
    linear = LinearBicycle.from_car(car, STEP_SPEED_MPS, compliance(flaws))
    expected = handling(car, compliance(flaws))
    understeer = np.radians(circle.understeer_deg_per_g) / GRAVITY_MPS2
    return (
        name,
        f"{circle.understeer_deg_per_g:.2f} ({np.degrees(expected.understeer) * GRAVITY_MPS2:.2f})",
        f"{3.6 * np.sqrt(expected.wheelbase / understeer):.0f}"
        f" ({3.6 * linear.characteristic_speed_mps:.0f})",
        f"{circle.sideslip_deg_per_g:.2f} ({-np.degrees(expected.rear_slip) * GRAVITY_MPS2:.2f})",
        f"{circle.largest_ay_mps2:.1f}",
        f"({linear.natural_frequency_hz:.2f})",
        f"({linear.damping:.2f})",
        f"{step.response_time_s:.2f}",
        f"{step.peak_time_s:.2f}",
        f"{100 * step.overshoot:.0f}",
        f"{highest_speed_kmh(car, flaws)}",
    )


def plot(folder: Path) -> None:
    """Draw the three manoeuvres of all cars."""
    mpl.rcParams["svg.hashsalt"] = "validation"
    figure, (first, middle, right) = plt.subplots(1, 3, figsize=(11, 3.6))
    for colour, (kind, file) in zip(("C0", "C1", "C2"), CARS.items(), strict=True):
        car = load_vehicle(file, SHIPPED_CONFIGS)
        for flaws, style, label in ((PERFECT, "--", None), (imperfections(), "-", kind)):
            circle = constant_radius(car, flaws)
            first.plot(circle.ay_mps2, circle.steering_deg, style, color=colour, label=label)
            step = step_steer(car, flaws)
            rate = step.response.yaw_rate_rad_s / step.steady_yaw_rate_rad_s
            middle.plot(step.response.time_s - 0.5, rate, style, color=colour)
            lane = double_lane_change(car, 60 / 3.6, flaws)
            right.plot(lane.station_m, np.degrees(lane.sideslip_rad), style, color=colour)
    first.set(xlabel="lateral acceleration, m/s²", ylabel="steering wheel / ratio, °")
    first.set_title("ISO 4138: circle of 100 m")
    first.legend(frameon=False)
    middle.set(xlabel="time, s", ylabel="yaw rate / steady yaw rate", xlim=(-0.2, 2))
    middle.set_title("ISO 7401: step to 4 m/s² at 80 km/h")
    right.set(xlabel="station, m", ylabel="side-slip angle, °")
    right.set_title("ISO 3888-1: lane change at 60 km/h")
    figure.tight_layout()
    figure.savefig(folder / "validation_manoeuvres.svg", metadata={"Date": None})


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plots", type=Path, help="folder for the picture")
    parser.add_argument("--document", type=Path, help="page to put the table into")
    arguments = parser.parse_args()
    lines = [HEADER, ("---",) * len(HEADER)]
    for kind, file in CARS.items():
        lines.append(row(kind, load_vehicle(file, SHIPPED_CONFIGS), PERFECT))
        print(lines[-1], flush=True)
        lines.append(
            row(f"{kind}, imperfect", load_vehicle(file, SHIPPED_CONFIGS), imperfections())
        )
        print(lines[-1], flush=True)
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    if arguments.document:
        insert(arguments.document, "validation", text)
    if arguments.plots:
        plot(arguments.plots)


if __name__ == "__main__":
    main()
