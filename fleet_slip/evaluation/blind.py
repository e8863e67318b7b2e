"""The blind set: test drives that cannot be drawn before a model is published.

Roads, cars, loads, tyres, weather, drivers and noise are drawn from the hash of the version under
test, by `configs/blind.toml`. The drives are simulated for each evaluation and not stored.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, load_config
from fleet_slip.evaluation.evaluator import Estimator, EvaluatedDrive, evaluate, pooled_statistics
from fleet_slip.evaluation.test_drives import TestDrive, simulate_drives
from fleet_slip.resources import Configs
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.drive_plans import Drivers, FleetPlan, load_by_name
from fleet_slip.simulation.imperfections import ImperfectionRanges, NotNegative, Range, Uniform
from fleet_slip.simulation.roads import CLASSES, draw_road, random_generator
from fleet_slip.simulation.scenario import Scenario


class Weather(Config):
    """Adhesion of the road, and the share of it that drivers use."""

    adhesion: Uniform
    friction_use: Uniform
    """Planned lateral acceleration over μ g."""


class BlindSet(Config):
    """Distributions of blind drives; each road is driven once in every weather."""

    campaign: Annotated[Campaign, load_by_name(load_campaign)]
    """Campaign of the cars, tyres, sensors and road surfaces."""
    roads: tuple[Identifier, ...] = Field(min_length=1)
    """The class of each road."""
    weather: dict[Identifier, Weather] = Field(min_length=1)
    load_kg: Range
    load_position_m: Range
    tyre_stiffness: Uniform
    """Stiffness of a new tyre over that of the vehicle's file."""
    tyre_wear_days: NotNegative
    """Maximum age of the tyres."""
    drivers: Drivers

    @property
    def _fleet(self) -> tuple[FleetPlan, ImperfectionRanges]:
        """The plan of the campaign's cars, and their imperfections."""
        plan = self.campaign.plan
        if not isinstance(plan, FleetPlan) or plan.imperfections is None:
            raise ValueError(
                f"{self.campaign.name} is not a campaign of a fleet with imperfections"
            )
        return plan, plan.imperfections

    @model_validator(mode="after")
    def _is_valid(self) -> Self:
        _ = self._fleet
        if unknown := [kind for kind in self.roads if kind not in CLASSES]:
            raise ValueError(f"{unknown[0]!r} is not a class of roads: {', '.join(CLASSES)}")
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
        generator = random_generator(seed, "blind", name)
        road = draw_road(kind, seed + number)
        adhesion = self.weather[weather].adhesion.draw(generator)
        use = self.weather[weather].friction_use.draw(generator)
        vehicle = plan.vehicles[generator.integers(len(plan.vehicles))]
        days = round(generator.uniform(0, self.tyre_wear_days))
        stiffer, smaller = flaws.wear(generator, days)
        content = {
            "name": name,
            "description": f"A {kind} road, {weather}",
            "vehicle": vehicle,
            "sprung_mass_kg": vehicle.body.sprung_mass_kg + self.load_kg.draw(generator),
            "load_position_m": self.load_position_m.draw(generator),
            "tyre_stiffness": self.tyre_stiffness.draw(generator) * stiffer,
            "tyre_radius": plan.tyre_radius.draw(generator) * smaller,
            "track": self.drivers.line(road, kind, generator),
            "adhesion": adhesion,
            "limits": self.drivers.limits(kind, adhesion, use, generator),
            "laps": 1,
            "seed": seed,
            "sensors": plan.sensor_bias_std.draw(self.campaign.sensors, generator),
            "imperfections": flaws.draw(generator, generator),
        }
        return Scenario.model_validate(content)


def blind_scenarios(sha256: str, configs: Configs) -> tuple[Scenario, ...]:
    """Draw the blind drives of the model version with this hash."""
    blind_set = load_config(configs.file("blind.toml"), BlindSet, configs)
    return blind_set.scenarios(int(sha256[:15], 16))


def evaluate_blind_drives(
    catalog: Catalog, sha256: str, estimators: Mapping[str, Estimator[TestDrive]]
) -> list[dict[str, Any]]:
    """Evaluate estimators on the blind drives of a model version.

    Returns `results` by estimator over all drives together, then by class of road, by weather and
    by drive. The reference is the simulator's own, not quantised as in a log.
    """
    drives = simulate_drives(catalog.signals, blind_scenarios(sha256, catalog.configs))
    runs = evaluate(drives, estimators)
    groups = {"all": list(runs)}
    for word in (0, -1):
        for run in runs:
            groups.setdefault(run.name.split("_")[word], []).append(run)
    groups |= {run.name: [run] for run in runs}
    return [_group_document(name, group) for name, group in groups.items()]


def _group_document(name: str, runs: Sequence[EvaluatedDrive[TestDrive]]) -> dict[str, Any]:
    truth = np.concatenate([run.drive.sideslip_rad[run.rows] for run in runs])
    errors = pooled_statistics(runs)
    return {
        "name": name,
        "drives": len(runs),
        "sideslip_std_deg": float(np.degrees(truth.std())),
        "results": {estimator: asdict(statistics) for estimator, statistics in errors.items()},
    }
