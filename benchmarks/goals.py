"""How far models are from what they should reach, kind of driving by kind, on blind roads.

    python -m benchmarks.goals DATA_ROOT MODEL [MODEL ...] [--roads 4]

Each kind of driving is on roads of its own that are drawn from the hash of the first model's
version, which nobody could know before it was published, with the drivers of `configs/blind.toml`.
The car is the sedan, with the paper's sensors, of which the filters know the class, or everything
(load and adhesion, too), with the noise that they state. Printed is the RMSE in degrees against the
exact angle, and the posterior Cramer-Rao bound of who does not know load, tyres and adhesion
(`benchmarks.bound`).
"""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import fleet_slip
from benchmarks.bound import UNKNOWN, bound_deg
from fleet_slip.comparison.evaluation.blind import BlindSet
from fleet_slip.comparison.evaluation.estimators import Estimate, published_estimate
from fleet_slip.comparison.evaluation.evaluated_drives import simulate_drives
from fleet_slip.comparison.evaluation.filters import FILTERS, FilterEstimate
from fleet_slip.comparison.evaluation.scenario_runs import error_figures, evaluate_drive
from fleet_slip.config import load_config
from fleet_slip.resources import config_file
from fleet_slip.simulation.random_numbers import random_generator
from fleet_slip.simulation.roads import draw_road
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, load_vehicle

CAR = "d_class_sedan"
OPEN = ("country", "hill")
TOP_SPEED_MPS = 35.0


@dataclass(frozen=True)
class Kind:
    """A kind of driving: its goal in degrees, classes of roads, and in what it differs."""

    goal_deg: float
    roads: tuple[str, ...] = OPEN
    adhesion: float = 1.0
    friction_use: float = 0.5
    """Planned lateral acceleration over adhesion times g, of a driver who sees the road."""
    others: Mapping[str, Any] = field(default_factory=dict)


def kinds() -> dict[str, Kind]:
    """Return the kinds of driving by name."""
    laden_kg = load_vehicle(CAR).body.sprung_mass_kg + 300
    leaning = load_scenario("imperfect_road").imperfections.model_dump()
    load = {"sprung_mass_kg": laden_kg, "load_position_m": -1.9}
    return {
        "country": Kind(0.035, ("country",)),
        "hill": Kind(0.040, ("hill",)),
        "300 kg behind the rear axle": Kind(0.15, others=load),
        "adhesion .55": Kind(0.10, adhesion=0.55, friction_use=0.7),
        "adhesion .5": Kind(0.10, adhesion=0.5, friction_use=0.7),
        "adhesion .4": Kind(0.10, adhesion=0.4, friction_use=0.7),
        "limit of grip": Kind(0.14, friction_use=0.82),
        "banked": Kind(0.06, others={"imperfections": leaning}),
    }


def scenarios(kind: str, one: Kind, seed: int, roads: int) -> Iterator[Scenario]:
    """Yield the drives of a kind."""
    drivers = load_config(config_file("blind.toml"), BlindSet).drivers
    for number in range(roads):
        road = one.roads[number % len(one.roads)]
        drawn = random_generator(seed, "goals", kind, str(number))
        track = draw_road(road, int(drawn.integers(2**60)))
        content = {
            "name": f"goal_{number}",
            "description": kind,
            "base": "nominal",
            "pace": [],
            "track": drivers.line(track, road, drawn),
            "adhesion": one.adhesion,
            "seed": number,
            "limits": {
                "lateral_mps2": one.friction_use * one.adhesion * GRAVITY_MPS2,
                "acceleration_mps2": 2.5 * one.adhesion,
                "braking_mps2": 4.0 * one.adhesion,
                "top_speed_mps": TOP_SPEED_MPS,
            },
            **one.others,
        }
        yield Scenario.model_validate(content)


def judged(some: list[Scenario], estimators: Mapping[str, Estimate]) -> tuple[list[float], float]:
    """Return the error of each estimator over all drives, and the bound, in degrees."""
    drives = [one for one in simulate_drives(some) if one.lost_control_s is None]
    runs = [evaluate_drive(drive, estimators) for drive in drives]
    truth = np.concatenate([drive.sideslip_rad for drive in drives])
    among = np.concatenate([drive.evaluated for drive in drives])
    errors = [
        error_figures(np.concatenate([run.estimates[name] for run in runs]), truth, among)
        for name in estimators
    ]
    rows = [drive.evaluated.sum() for drive in drives]
    squares = [bound_deg(drive, UNKNOWN) ** 2 for drive in drives]
    bound = float(np.sqrt(np.average(squares, weights=rows)))
    return [one.rmse_deg if one.rmse_deg is not None else np.nan for one in errors], bound


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--roads", type=int, default=4)
    options = parser.parse_args()
    fleet = fleet_slip.open(options.root)
    versions = [fleet.resolve(name) for name in options.models]
    estimators: dict[str, Estimate] = {
        one.reference: published_estimate(one.manifest) for one in versions
    }
    for one in FILTERS:
        if one.module == "ekf":
            estimators[one.name] = FilterEstimate(one, one.parameters, load_vehicle(CAR))
    seed = int(versions[0].sha256[:15], 16)
    print("| | goal |", " | ".join(estimators), "| bound |")
    print("| --- " * (len(estimators) + 3) + "|")
    drives = {"nominal": (0.012, [load_scenario("nominal")])} | {
        kind: (one.goal_deg, list(scenarios(kind, one, seed, options.roads)))
        for kind, one in kinds().items()
    }
    for kind, (goal_deg, some) in drives.items():
        errors, bound = judged(some, estimators)
        shown = " | ".join(f"{error:.3f}" for error in errors)
        print(f"| {kind} | {goal_deg:.3f} | {shown} | {bound:.4f} |", flush=True)


if __name__ == "__main__":
    main()
