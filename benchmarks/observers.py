"""Steps per second of both Kalman filters, over drives on threads.

    python -m benchmarks.observers [--rows 30000] [--drives 64]

A step is one row of one drive through the whole estimator: for the Kalman filter the yaw rate
filter, prediction, the update at every tenth row, and the angle.
"""

import argparse
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from os import cpu_count
from time import perf_counter
from typing import Any

import numpy as np

from fleet_slip.comparison.observers import ekf, kalman
from fleet_slip.comparison.observers.drive_signals import STEP_S, DriveSignals
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle

REPEATS = 5

ESTIMATORS: dict[str, Callable[..., Any]] = {
    "kalman": partial(kalman.estimate, noise=kalman.FilterNoise()),
    "ekf": partial(ekf.estimate, noise=ekf.EkfNoise()),
}


def slalom(car: VehicleParameters, rows: int, seed: int) -> DriveSignals:
    """Return a drive of noisy signals on a winding road."""
    noise = np.random.default_rng(seed).standard_normal((9, rows))
    time_s = np.arange(rows) * STEP_S
    yaw_rate = 0.2 * np.sin(0.3 * time_s)
    spin = 20.0 / car.tyre.rolling_radius_m + 0.02 * noise[:4]
    turn = yaw_rate * car.body.track_rear_m / 2 / car.tyre.rolling_radius_m
    steer = yaw_rate * car.body.wheelbase_m / 20.0
    fix = np.where(np.arange(rows) % 10 == 0, 0.0, np.nan)
    return DriveSignals(
        ax_mps2=0.1 * noise[4],
        ay_mps2=20.0 * yaw_rate + 0.1 * noise[5],
        yaw_rate_rad_s=yaw_rate + 0.01 * noise[6],
        wheel_fl_rad_s=spin[0] - turn,
        wheel_fr_rad_s=spin[1] + turn,
        wheel_rl_rad_s=spin[2] - turn,
        wheel_rr_rad_s=spin[3] + turn,
        steer_fl_rad=steer,
        steer_fr_rad=steer,
        gps_vx_mps=20.0 + 0.05 * noise[7] + fix,
        gps_vy_mps=0.05 * noise[8] + fix,
    )


def steps_per_second(
    estimate: Callable[[DriveSignals], Any], drives: list[DriveSignals], threads: int
) -> float:
    """Return the best rate of several runs over all drives."""
    best = float("inf")
    with ThreadPoolExecutor(threads) as executor:
        for _ in range(REPEATS):
            begin = perf_counter()
            list(executor.map(estimate, drives))
            best = min(best, perf_counter() - begin)
    return sum(map(len, drives)) / best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=30_000, help="of a drive")
    parser.add_argument("--drives", type=int, default=64)
    given = parser.parse_args()
    car = load_vehicle("d_class_sedan")
    drives = [slalom(car, given.rows, seed) for seed in range(given.drives)]
    cores = cpu_count() or 1
    print(f"{given.drives} drives of {given.rows} rows; million steps/s, best of {REPEATS}")
    for name, estimator in ESTIMATORS.items():
        estimate = partial(estimator, car=car)
        estimate(drives[0])  # compiles
        rates = {threads: steps_per_second(estimate, drives, threads) for threads in (1, cores)}
        shown = ", ".join(f"{threads} threads {rate / 1e6:.1f}" for threads, rate in rates.items())
        print(f"{name:13} {shown}")


if __name__ == "__main__":
    main()
