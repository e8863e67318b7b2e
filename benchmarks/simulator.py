"""How fast drives are simulated, beside highway-env's own vehicle, in one run.

    python -m benchmarks.simulator [--seconds 3] [--threads 1 2]

Each is timed in several rounds, in turn, and the best round counts, as it was disturbed least.
A sample is one car moved on by 0.01 s: by one `BicycleVehicle.step`, or by five steps of 2 ms with
driver, road and recording. Drives are shorter than a lap and a half below `--seconds 0.4`.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from highway_env.vehicle.dynamics import BicycleVehicle

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.roads import SpeedLimits, load_track, speed_profile
from fleet_slip.vehicle.batch import STEPS_PER_SAMPLE, LaneDrive, Road
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.highway import FourWheelVehicle
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.rolling import simulate_drives

ROUNDS = 5
DRIVES = 32


def fleet(laps: float) -> list[LaneDrive]:
    """Return drives on Waterford Hills, each at another speed and mass."""
    track = load_track("waterford_hills", SHIPPED_CONFIGS)
    limits = SpeedLimits(
        lateral_mps2=5.0, acceleration_mps2=2.5, braking_mps2=4.0, top_speed_mps=45.0
    )
    profile = speed_profile(track, limits, spacing_m=1.0)
    curvature, sedan = (
        track.curvature(profile.station_m),
        load_vehicle("d_class_sedan", SHIPPED_CONFIGS),
    )
    return [
        LaneDrive(
            sedan.with_sprung_mass(1000.0 + 20.0 * i),
            Road(
                profile.spacing_m,
                curvature,
                (0.7 + 0.01 * i) * profile.speed_mps,
                track.length_m,
                track.closed,
            ),
            1.0,
            laps,
        )
        for i in range(DRIVES)
    ]


def vehicle_rate(kind: type[BicycleVehicle], seconds: float) -> float:
    """Return steps per second of a highway-env vehicle in a gentle bend."""
    vehicle = kind(None, [0.0, 0.0], speed=20.0)
    vehicle.act({"steering": 0.01, "acceleration": 0.0})
    vehicle.step(SAMPLE_S)
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        for _ in range(200):
            vehicle.step(SAMPLE_S)
        steps += 200
    return steps / (time.perf_counter() - start)


def lanes_rate(
    drives: list[LaneDrive], seconds: float, threads: int, steps: int = STEPS_PER_SAMPLE
) -> float:
    """Return vehicle-samples per second of the lane kernel on some threads."""

    def work(_: int) -> int:
        samples, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            samples += sum(len(b.channels["vx_mps"]) for b in simulate_drives(drives, steps))
        return samples

    start = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        samples = sum(pool.map(work, range(threads)))
    return samples / (time.perf_counter() - start)


def print_precision(drives: list[LaneDrive], seconds: float) -> None:
    """Print the error of the side-slip angle and the rate over the length of the step."""
    exact = simulate_drives(drives, steps_per_sample=320)
    print(f"\n{'step, ms':>10}{'largest error of side-slip, deg':>34}{'samples/s':>14}")
    for steps in (2, 3, 4, 5, 10, 20, 40):
        error = max(
            float(np.abs(expected.sideslip_rad[:n] - other.sideslip_rad[:n]).max())
            for expected, other in zip(exact, simulate_drives(drives, steps), strict=True)
            for n in [min(len(expected.vx_mps), len(other.vx_mps))]
        )
        rate = max(lanes_rate(drives, seconds, 1, steps) for _ in range(ROUNDS))
        print(f"{1000 * SAMPLE_S / steps:10.2f}{np.degrees(error):34.5f}{rate:14,.0f}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0, help="time for each measurement")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    share = arguments.seconds / ROUNDS
    drives = fleet(min(1.5, 4 * arguments.seconds))
    simulate_drives(drives[:1])
    subjects: dict[str, Callable[[], float]] = {
        "highway-env BicycleVehicle.step": partial(vehicle_rate, BicycleVehicle, share),
        "FourWheelVehicle.step": partial(vehicle_rate, FourWheelVehicle, share),
    }
    for threads in arguments.threads:
        subjects[f"lanes, threads: {threads}"] = partial(lanes_rate, drives, share, threads)
    rates: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(ROUNDS):
        for name, run in subjects.items():
            rates[name].append(run())
    base = max(rates["highway-env BicycleVehicle.step"])
    print(f"{'':34}{'best samples/s':>16}{'median':>14}{'ratio':>8}")
    for name, values in rates.items():
        best = max(values)
        print(f"{name:34}{best:16,.0f}{np.median(values):14,.0f}{best / base:8.1f}")
    print_precision(drives, share)


if __name__ == "__main__":
    main()
