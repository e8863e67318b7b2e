"""The blind set: test drives that nobody can look at before a model is published.

Roads, cars, loads, tyres, weather, drivers and noise are drawn from the hash of the version that is
judged (`configs/blind.toml` says from what). The drives are simulated for the judgement and kept
nowhere: whoever has the version draws them again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, load_config
from fleet_slip.evaluation.drives import simulate_drives
from fleet_slip.evaluation.judge import Estimate, EvaluatedScenario, evaluate_drive, judge
from fleet_slip.resources import Configs
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.imperfections import ImperfectionRanges, NotNegative, Range, Uniform
from fleet_slip.simulation.plan import Drivers, FleetPlan, load_by_name
from fleet_slip.simulation.roads import CLASSES, draw_road, random_generator
from fleet_slip.simulation.scenario import Scenario


class Weather(Config):
    """Adhesion of the road, and how much of it a driver uses who sees it."""

    adhesion: Uniform
    friction_use: Uniform
    """Planned lateral acceleration over μ g."""


class BlindSet(Config):
    """From what blind drives are drawn: each road once in every weather."""

    campaign: Annotated[Campaign, load_by_name(load_campaign)]
    """Whose cars, tyres, sensors and surfaces of roads are drawn."""
    roads: tuple[Identifier, ...] = Field(min_length=1)
    """The class of each road."""
    weather: dict[Identifier, Weather] = Field(min_length=1)
    load_kg: Range
    load_position_m: Range
    tyre_stiffness: Uniform
    """Of a new tyre, over that of the vehicle's file."""
    tyre_wear_days: NotNegative
    """Tyres have been driven for up to so many days."""
    drivers: Drivers

    @property
    def _fleet(self) -> tuple[FleetPlan, ImperfectionRanges]:
        """The plan of the campaign's cars, and what is imperfect about them."""
        plan = self.campaign.plan
        if not isinstance(plan, FleetPlan) or plan.imperfections is None:
            raise ValueError(
                f"{self.campaign.name} is not a campaign of a fleet with imperfections"
            )
        return plan, plan.imperfections

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        _ = self._fleet
        if strange := [kind for kind in self.roads if kind not in CLASSES]:
            raise ValueError(f"{strange[0]!r} is not a class of roads: {', '.join(CLASSES)}")
        return self

    def scenarios(self, seed: int) -> tuple[Scenario, ...]:
        """Draw the drives: one for each road and weather, in this order."""
        return tuple(
            self._scenario(seed, number, kind, weather)
            for number, kind in enumerate(self.roads)
            for weather in self.weather
        )

    def _scenario(self, seed: int, number: int, kind: str, weather: str) -> Scenario:
        plan, flaws = self._fleet
        name = f"{kind}_{number}_{weather}"
        of_drive = random_generator(seed, "blind", name)
        road = draw_road(kind, seed + number)
        adhesion = self.weather[weather].adhesion.draw(of_drive)
        use = self.weather[weather].friction_use.draw(of_drive)
        vehicle = plan.vehicles[of_drive.integers(len(plan.vehicles))]
        days = round(of_drive.uniform(0, self.tyre_wear_days))
        stiffer, smaller = flaws.wear(of_drive, days)
        content = {
            "name": name,
            "description": f"A {kind} road, {weather}",
            "vehicle": vehicle,
            "sprung_mass_kg": vehicle.body.sprung_mass_kg + self.load_kg.draw(of_drive),
            "load_position_m": self.load_position_m.draw(of_drive),
            "tyre_stiffness": self.tyre_stiffness.draw(of_drive) * stiffer,
            "tyre_radius": plan.tyre_radius.draw(of_drive) * smaller,
            "track": self.drivers.line(road, kind, of_drive),
            "adhesion": adhesion,
            "limits": self.drivers.limits(kind, adhesion, use, of_drive),
            "laps": 1,
            "seed": seed,
            "sensors": plan.sensor_bias_std.draw(self.campaign.sensors, of_drive),
            "imperfections": flaws.draw(of_drive, of_drive),
        }
        return Scenario.model_validate(content)


def blind_scenarios(sha256: str, configs: Configs) -> tuple[Scenario, ...]:
    """Return the drives that the model version with this hash is judged on."""
    blind = load_config(configs.file("blind.toml"), BlindSet, configs)
    return blind.scenarios(int(sha256[:15], 16))


def judge_blindly(
    catalog: Catalog, sha256: str, estimators: Mapping[str, Estimate]
) -> list[dict[str, Any]]:
    """Judge estimators on the drives that belong to a model version.

    Returns `results` by estimator over all drives together, then by class of road, by weather and
    by drive. The truth is the simulator's own, not what a log would keep of it.
    """
    scenarios = blind_scenarios(sha256, catalog.configs)
    drives = simulate_drives(catalog.signals, scenarios)
    runs = [evaluate_drive(drive, estimators) for drive in drives]
    groups = {"all": runs}
    for place in (0, -1):
        for run in runs:
            groups.setdefault(run.name.split("_")[place], []).append(run)
    groups |= {run.name: [run] for run in runs}
    return [_group(name, some) for name, some in groups.items()]


def _group(name: str, runs: Sequence[EvaluatedScenario]) -> dict[str, Any]:
    truth = np.concatenate([run.truth_rad[run.evaluated] for run in runs])
    return {
        "name": name,
        "drives": len(runs),
        "sideslip_std_deg": float(np.degrees(truth.std())),
        "results": {name: asdict(found) for name, found in judge(runs).items()},
    }
