"""How far models are from what they should reach, kind of driving by kind, on blind roads.

    python -m benchmarks.goals DATA_ROOT MODEL [MODEL ...] [--roads 4] [--draws 5]
    python -m benchmarks.goals DATA_ROOT MODEL --nights

Each kind of driving is on roads of its own, drawn from the hash of the first model's version, which
nobody could know before it was published, with the drivers of `configs/blind.toml`. The car is the
sedan, with the paper's sensors, of which the filters know the class, or everything (load and
adhesion, too), tuned on the first model's drives. Printed is the RMSE in degrees against the exact
angle, at last on each of so many `--draws` of 24 blind drives.

`--nights`: nine drives of two minutes, the fourth to the sixth with the load, of a car that
remembers so many of 256 parts of what it learned from drive to drive.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import Any

import numpy as np

import fleet_slip
from fleet_slip.config import load_config
from fleet_slip.evaluation.evaluated_drives import (
    BlindSet,
    TestDrive,
    blind_scenarios,
    simulate_drives,
)
from fleet_slip.evaluation.evaluator import Estimator as DriveEstimator
from fleet_slip.evaluation.evaluator import evaluate, pooled_statistics
from fleet_slip.evaluation.scenario_evaluation import train_competitors
from fleet_slip.export.stepping import Estimator
from fleet_slip.models.registry import ModelVersion
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.roads import draw_road, random_generator
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, load_vehicle
from tests.support.catalog import CATALOG, SIGNALS

CAR = "d_class_sedan"
OPEN = ("country", "hill")
LADEN = "300 kg behind the rear axle"
MINUTE_TICKS = 6000
TOP_SPEED_MPS = 35.0


@dataclass(frozen=True)
class Kind:
    """A kind of driving: its goal in degrees, classes of roads, and in what it differs."""

    goal_deg: float
    roads: tuple[str, ...] = OPEN
    adhesion: float = 1.0
    friction_use: float = 0.5
    """Planned lateral acceleration over adhesion times g, of a driver who sees the road."""
    overrides: Mapping[str, Any] = field(default_factory=dict)


def kinds() -> dict[str, Kind]:
    """Return the kinds of driving by name."""
    laden_kg = load_vehicle(CAR, SHIPPED_CONFIGS).body.sprung_mass_kg + 300
    leaning = load_scenario("imperfect_road", SHIPPED_CONFIGS).imperfections
    load = {"sprung_mass_kg": laden_kg, "load_position_m": -1.9}
    return {
        "country": Kind(0.035, ("country",)),
        "hill": Kind(0.046, ("hill",)),
        LADEN: Kind(0.16, overrides=load),
        "adhesion .55": Kind(0.105, adhesion=0.55, friction_use=0.7),
        "adhesion .5": Kind(0.105, adhesion=0.5, friction_use=0.7),
        "adhesion .4": Kind(0.105, adhesion=0.4, friction_use=0.7),
        "limit of grip": Kind(0.14, friction_use=0.82),
        "banked": Kind(0.058, overrides={"imperfections": leaning.model_dump()}),
    }


def scenarios(kind: str, parameters: Kind, seed: int, roads: int) -> Iterator[Scenario]:
    """Yield the drives of a kind."""
    drivers = load_config(SHIPPED_CONFIGS.file("blind.toml"), BlindSet, SHIPPED_CONFIGS).drivers
    for number in range(roads):
        road = parameters.roads[number % len(parameters.roads)]
        drawn = random_generator(seed, "goals", kind, str(number))
        track = draw_road(road, int(drawn.integers(2**60)))
        yield Scenario.model_validate(
            {
                "name": f"goal_{number}",
                "description": kind,
                "base": "nominal",
                "pace": [],
                "track": drivers.line(track, road, drawn),
                "adhesion": parameters.adhesion,
                "seed": number,
                "limits": {
                    "lateral_mps2": parameters.friction_use * parameters.adhesion * GRAVITY_MPS2,
                    "acceleration_mps2": 2.5 * parameters.adhesion,
                    "braking_mps2": 4.0 * parameters.adhesion,
                    "top_speed_mps": TOP_SPEED_MPS,
                },
                **parameters.overrides,
            },
            context=SHIPPED_CONFIGS,
        )


def errors_deg(
    scenarios: Sequence[Scenario],
    estimators: Mapping[str, DriveEstimator[TestDrive]],
    *,
    laden: bool = False,
) -> list[float]:
    """Return the RMSE of each estimator over all drives in which no car is lost.

    `laden`: judged at the centre of gravity of the loaded car instead of the empty one.
    """
    drives = [
        simulated
        for simulated in simulate_drives(SIGNALS, scenarios)
        if simulated.lost_control_s is None
    ]
    if laden:
        drives = [_laden(drive) for drive in drives]
    errors = pooled_statistics(evaluate(drives, estimators))
    return [errors[name].rmse_deg or float("nan") for name in estimators]


def _laden(drive: TestDrive) -> TestDrive:
    turned = drive.scenario.car.body.reference_m * drive.columns["yaw_rate_rad_s"]
    turned = turned / np.maximum(drive.vx_mps, 1.0)
    return replace(drive, vy_mps=drive.vy_mps - drive.vx_mps * turned)


def print_nights(version: ModelVersion, seed: int) -> None:
    """Print the error of each drive's first and second minute, by what is remembered."""
    selected = {
        kind: parameters for kind, parameters in kinds().items() if kind in ("country", LADEN)
    }
    order = ["country"] * 3 + [LADEN] * 3 + ["country"] * 3
    sequence = [next(scenarios(kind, selected[kind], seed + i, 1)) for i, kind in enumerate(order)]
    drives = [
        drive for parameters in sequence for drive in simulate_drives(SIGNALS, [parameters])
    ]  # all of one name
    print("| remembered |", " | ".join(f"{i}: {kind}" for i, kind in enumerate(order, 1)), "|")
    print("| --- " * (len(order) + 1) + "|")
    for retained in (0, 128, 200, 240, 256):
        estimator, errors = Estimator(CATALOG, version.manifest), []
        for drive in drives:
            estimator.restart(retained)
            rows = min(2 * MINUTE_TICKS, len(drive.time_s))
            columns = [drive.columns[name][:rows].tolist() for name in estimator.columns]
            angles = [
                estimator.step(dict(zip(estimator.columns, sample, strict=True)))
                for sample in zip(*columns, strict=True)
            ]
            error = np.array(angles, dtype=float) - drive.sideslip_rad[:rows]
            parts = (error[:MINUTE_TICKS], error[MINUTE_TICKS:])
            errors.append(", ".join(f"{np.degrees(np.sqrt(np.nanmean(e**2))):.3f}" for e in parts))
        print(f"| {retained} | {' | '.join(errors)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--roads", type=int, default=4)
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--nights", action="store_true")
    options = parser.parse_args()
    fleet = fleet_slip.open(options.root)
    versions = [fleet.models.get(name) for name in options.models]
    seed = int(versions[0].sha256[:15], 16)
    if options.nights:
        print_nights(versions[0], seed)
        return
    with ThreadPoolExecutor(2) as executor:
        _, bank = train_competitors(fleet.warehouse, versions[0], versions[1:], executor)
    names = [item.reference for item in versions] + [
        name for name in bank if name.startswith("ekf")
    ]
    estimators = {name: bank[name][0] for name in names}
    drives = {"nominal": (0.014, [load_scenario("nominal", SHIPPED_CONFIGS)])} | {
        kind: (item.goal_deg, list(scenarios(kind, item, seed, options.roads)))
        for kind, item in kinds().items()
    }
    print("| | goal |", " | ".join(estimators), "|")
    print("| --- " * (len(estimators) + 2) + "|")
    for kind, (goal_deg, cases) in drives.items():
        cells = " | ".join(f"{error:.3f}" for error in errors_deg(cases, estimators))
        print(f"| {kind} | {goal_deg:.3f} | {cells} |", flush=True)
        if cases[0].load_position_m is not None:
            cells = " | ".join(f"{e:.3f}" for e in errors_deg(cases, estimators, laden=True))
            print(f"| the same, at the laden centre of gravity | | {cells} |", flush=True)
    for number in range(options.draws):
        drawn = sha256(f"{versions[0].sha256} {number}".encode()).hexdigest()
        cells = " | ".join(
            f"{e:.3f}" for e in errors_deg(blind_scenarios(drawn, SHIPPED_CONFIGS), estimators)
        )
        print(f"| 24 blind drives, draw {number + 1} | | {cells} |", flush=True)


if __name__ == "__main__":
    main()
