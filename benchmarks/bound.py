"""How close to the limit estimators come: a posterior Cramér-Rao bound for each test drive.

    python -m benchmarks.bound DATA_ROOT

Tichavský, Muravchik and Nehorai, "Posterior Cramér-Rao bounds for discrete-time nonlinear
filtering", IEEE Transactions on Signal Processing 46 (1998): along the true motion the information
obeys the filter's recursion, so that P ← F P Fᵀ + Q, P⁻¹ ← P⁻¹ + Hᵀ R⁻¹ H bounds every estimator
without bias. The laws are those of the extended filter (`single_track`): axles under the loads of
the moment. Beside vx, vy and yaw rate the state has the biases of both accelerometers and of the
gyroscope, and logarithms of mass, tyre stiffness and adhesion, all unknown but for a prior. The
steering angle and wheel radius are taken as known and wheels as rolling, which lowers the bound.
Of a drive of the data root's latest evaluation it prints the bound of who does not know the car, of
who is told it, and how many times that the estimators err.
"""

import argparse
from pathlib import Path

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.evaluate import evaluations_of
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive, load_drives
from fleet_slip.comparison.evaluation.filters import seen
from fleet_slip.comparison.observers.drive_signals import STEP_S
from fleet_slip.comparison.observers.ekf import INITIAL_STD, chassis
from fleet_slip.comparison.observers.single_track import (
    Axles,
    Chassis,
    loaded_axles,
    measured_steer_rad,
    rates,
)
from fleet_slip.compiling import kernel
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.warehouse.tables import Warehouse

BIASES = (0.15, 0.15, 0.01)
"""Standard deviations of ax, ay (m/s²) and yaw rate (rad/s)."""

UNKNOWN = (0.1, 0.15, 0.3)
"""Of the logarithms of mass, stiffness and adhesion."""

TOLD = (1e-9, 1e-9, 1e-9)

STEP = 1e-4
SHOWN = ("ekf_told_tuned", "ekf_identified", "ekf_class_tuned")


@kernel
def _moved(state: FloatArray, axles: FloatArray, steer: float, c: Chassis) -> FloatArray:
    """Return what the state becomes but for known accelerations, and the lateral acceleration."""
    scaled = axles[0] + (axles[1:] - axles[0]).T @ (state[6:] / STEP)
    grip = Axles(scaled[0], scaled[1], scaled[2], scaled[3])
    heavier = np.exp(state[6])
    own = Chassis(c.mass_kg * heavier, c.yaw_inertia_kgm2 * heavier, c.front_m, c.rear_m)
    d = rates(state[0], state[1], state[2], steer, grip, own)
    after = np.empty(10)
    after[:9] = state
    after[0] += STEP_S * (state[2] * state[1] - state[3])
    after[1] += STEP_S * (d.ay - state[2] * state[0])
    after[2] += STEP_S * d.yaw
    after[9] = d.ay
    return after


@kernel
def _variances(
    motion: FloatArray,
    axles: FloatArray,
    steer: FloatArray,
    prior: FloatArray,
    noise: FloatArray,
    c: Chassis,
) -> FloatArray:
    """Return the bound of the variance of vy / vx at every row."""
    found = np.empty(motion.shape[1])
    p = np.diag(prior**2)
    slopes = np.empty((10, 9))
    rows = np.zeros((4, 9))
    for k in range(motion.shape[1]):
        state = np.zeros(9)
        state[:3] = motion[:, k]
        for i in range(9):
            step = np.zeros(9)
            step[i] = STEP
            above = _moved(state + step, axles[:, :, k], steer[k], c)
            slopes[:, i] = (above - _moved(state - step, axles[:, :, k], steer[k], c)) / (2 * STEP)
        rows[0, 0] = 1.0  # wheels: vx
        rows[1, 2] = 1.0  # their difference: yaw rate
        rows[2, 2], rows[2, 5] = 1.0, 1.0  # gyroscope
        rows[3] = slopes[9]
        rows[3, 4] += 1.0  # lateral accelerometer
        for i in range(4):
            u = p @ rows[i]
            p = p - np.outer(u, u) / (rows[i] @ u + noise[i] ** 2)
        vx, vy = state[0], state[1]
        across = p[1, 1] - 2 * vy / vx * p[0, 1] + (vy / vx) ** 2 * p[0, 0]
        found[k] = across / vx**2
        p = slopes[:9] @ p @ slopes[:9].T
        p[0, 0] += (STEP_S * noise[4]) ** 2
        p = (p + p.T) / 2
    return found


def bound_deg(drive: EvaluatedDrive, of_car: tuple[float, float, float]) -> float:
    """Return the root mean square of the bound over a drive, for a prior of the car."""
    scenario, signals = drive.scenario, seen(drive.signals)
    car, sensors = scenario.car, scenario.sensors
    ax = np.nan_to_num(signals.ax_mps2 - sensors.ax_bias_mps2)
    ay = np.nan_to_num(signals.ay_mps2 - sensors.ay_bias_mps2)
    heavier = car.with_sprung_mass(car.body.sprung_mass_kg + STEP * car.body.mass_kg)
    axles = np.stack(
        [
            loaded_axles(car, ax, ay, scenario.adhesion),
            loaded_axles(heavier, ax, ay, scenario.adhesion),
            loaded_axles(car.with_tyres(stiffness_factor=1 + STEP), ax, ay, scenario.adhesion),
            loaded_axles(car, ax, ay, scenario.adhesion * (1 + STEP)),
        ]
    )
    wheel = car.tyre.rolling_radius_m * sensors.wheel_speed_std_rad_s
    noise = np.array(
        [
            wheel / np.sqrt(2),
            np.sqrt(2) * wheel / car.body.track_rear_m,
            sensors.yaw_rate_std_rad_s,
            sensors.acceleration_std_mps2,
            sensors.acceleration_std_mps2,
        ]
    )
    turning = np.nan_to_num(signals.yaw_rate_rad_s - sensors.yaw_rate_bias_rad_s)
    motion = np.stack([np.maximum(drive.vx_mps, 1.0), drive.vy_mps, turning])
    prior = np.array([*INITIAL_STD, *BIASES, *of_car])
    found = _variances(motion, axles, measured_steer_rad(signals), prior, noise, chassis(car))
    return float(np.degrees(np.sqrt(np.mean(found[drive.evaluated]))))


def main() -> None:
    """Print the bounds of every drive of the latest evaluation, and how far estimators are off."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    warehouse = Warehouse(LocalFolder(parser.parse_args().root))
    kept = evaluations_of(warehouse)
    content = kept.read(kept.numbers()[-1]).content
    results = {one["name"]: one["results"] for one in content["scenarios"] if not one["failures"]}
    names = (content["ranking"]["estimator"], *SHOWN)
    print("| drive | bound | told the car |", " | ".join(names), "|")
    for drive in load_drives(warehouse, [load_scenario(name) for name in results]):
        name = drive.scenario.name
        unknown, told = (bound_deg(drive, of_car) for of_car in (UNKNOWN, TOLD))
        times = [f"{results[name][one]['rmse_deg'] / unknown:.1f}" for one in names]
        print(f"| {name} | {unknown:.4f} | {told:.4f} |", " | ".join(times), "|", flush=True)


if __name__ == "__main__":
    main()
