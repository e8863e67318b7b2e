"""The blind set: test drives that nobody can look at before a model is published.

Roads, cars, loads, tyres, weather, drivers and noise are drawn from the hash of the version that is
judged (`configs/blind.toml` says from what). The drives are simulated for the judgement and kept
nowhere: whoever has the version draws them again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import Identifier
from fleet_slip.config import Config, load_config
from fleet_slip.evaluation.drives import EvaluatedDrive, simulate_drives
from fleet_slip.evaluation.filters import Estimate, FilterEstimate
from fleet_slip.evaluation.scenarios import (
    ErrorFigures,
    EvaluatedScenario,
    error_figures,
    evaluate_drive,
    judge_together,
)
from fleet_slip.resources import config_file
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.imperfections import ImperfectionRanges, NotNegative, Range, Uniform
from fleet_slip.simulation.plan import Drivers, FleetPlan, load_by_name
from fleet_slip.simulation.roads import CLASSES, draw_road, random_generator
from fleet_slip.simulation.scenario import Scenario
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ

ALL = "all"
"""What the figures over all drives are called, beside those of a class of road or a weather."""


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
            raise ValueError(f"{self.campaign.name} is no campaign of a fleet with imperfections")
        return plan, plan.imperfections

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        _ = self._fleet
        if strange := [kind for kind in self.roads if kind not in CLASSES]:
            raise ValueError(f"{strange[0]!r} is no class of roads: {', '.join(CLASSES)}")
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


def blind_scenarios(sha256: str) -> tuple[Scenario, ...]:
    """Return the drives that the model version with this hash is judged on."""
    return load_config(config_file("blind.toml"), BlindSet).scenarios(int(sha256[:15], 16))


@dataclass(frozen=True)
class BlindRow:
    """Figures of every estimator on some blind drives: one, all of a class or weather, or all.

    Attributes:
        name: of the drive, the class, the weather, or `ALL`.
        drives: how many.
        speed_mps: least and largest true speed.
        sideslip_std_deg: how much the angle varies.
        figures: by estimator, over all rows of the drives together.
    """

    name: str
    drives: int
    speed_mps: tuple[float, float]
    sideslip_std_deg: float
    figures: Mapping[str, ErrorFigures]

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return asdict(self)


def judge_blindly(sha256: str, estimators: Mapping[str, Estimate]) -> tuple[BlindRow, ...]:
    """Judge estimators on the drives that belong to a model version.

    Returns a row over all drives, one for each class of road, each weather and each drive. The
    truth is the simulator's own, not what a log would keep of it.
    """
    drives = simulate_drives(blind_scenarios(sha256))
    runs = [evaluate_drive(drive, estimators) for drive in drives]
    words = [run.scenario.name.split("_") for run in runs]
    groups = {ALL: runs}
    for place in (0, -1):
        for run, parts in zip(runs, words, strict=True):
            groups.setdefault(parts[place], []).append(run)
    return tuple(
        _row(name, some)
        for name, some in [*groups.items(), *((run.scenario.name, [run]) for run in runs)]
    )


def _row(name: str, runs: Sequence[EvaluatedScenario]) -> BlindRow:
    truths = [run.drive.sideslip_rad for run in runs]
    among = [run.drive.evaluated for run in runs]
    truth = np.concatenate(truths)[np.concatenate(among)]
    speed = np.concatenate([run.drive.speed_mps for run in runs])
    return BlindRow(
        name=name,
        drives=len(runs),
        speed_mps=(float(speed.min()), float(speed.max())),
        sideslip_std_deg=float(np.degrees(truth.std())),
        figures=judge_together(
            {name: [run.estimates[name] for run in runs] for name in runs[0].estimates},
            truths,
            among,
        ),
    )


# The paper's Figure 8: below which noise of satellite navigation its filter is better.
#
# The GPS velocity of one test drive is drawn again from the true one, without outages, with white
# noise of several sizes. The filter is told each. The regression, which uses no GPS, stays the
# same.

SCENARIO = "nominal"
LEVELS_MPS = (0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.04, 0.05, 0.06, 0.08, 0.1)
"""Standard deviations of the GPS velocity, along and across."""

DRAWS = 5
"""Draws of the noise at each level; the same ones, scaled, at all levels."""

SEED = 8
STATED = ("gps_vx_std_mps", "gps_vy_std_mps")
"""The filter's parameters that say how noisy GPS is."""


@dataclass(frozen=True)
class GpsLevel:
    """RMSE in degrees of each filter at one standard deviation of the GPS velocity."""

    velocity_std_mps: float
    rmse_deg: Mapping[str, float]


@dataclass(frozen=True)
class GpsSweep:
    """Filters by rising GPS noise on a test drive, and RMSE in deg of regressions without GPS."""

    scenario: str
    rate_hz: int
    levels: tuple[GpsLevel, ...]
    regressions: Mapping[str, float]

    def equal_at_mps(self, name: str, rmse_deg: float) -> float | None:
        """Return the noise at which a filter's RMSE reaches a value, interpolated; else None."""
        for low, high in pairwise(self.levels):
            below, above = low.rmse_deg[name], high.rmse_deg[name]
            if below <= rmse_deg <= above and below < above:
                share = (rmse_deg - below) / (above - below)
                return low.velocity_std_mps + share * (high.velocity_std_mps - low.velocity_std_mps)
        return None

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "scenario": self.scenario,
            "rate_hz": self.rate_hz,
            "draws": DRAWS,
            "levels": [asdict(level) for level in self.levels],
            "regressions": dict(self.regressions),
            "equal_at_mps": {
                name: {
                    regression: self.equal_at_mps(name, rmse_deg)
                    for regression, rmse_deg in self.regressions.items()
                }
                for name in self.levels[0].rmse_deg
            },
        }


def sweep_gps_noise(
    runs: Sequence[EvaluatedScenario],
    filters: Mapping[str, FilterEstimate],
    regressions: Sequence[str],
) -> GpsSweep | None:
    """Sweep the filters that use GPS on the nominal drive; None if it is not among the runs."""
    run = next((run for run in runs if run.scenario.name == SCENARIO), None)
    if run is None:
        return None
    levels = tuple(
        GpsLevel(std, {name: rmse_deg(run.drive, one, std) for name, one in filters.items()})
        for std in LEVELS_MPS
    )
    errors = {name: run.results[name].whole.rmse_deg for name in regressions}
    return GpsSweep(
        SCENARIO,
        run.scenario.sensors.gps.rate_hz,
        levels,
        {name: error for name, error in errors.items() if error is not None},
    )


def rmse_deg(drive: EvaluatedDrive, one: FilterEstimate, velocity_std_mps: float) -> float:
    """Return a filter's RMSE in deg over all draws; it believes as much more noise as there is."""
    stated = drive.scenario.sensors.gps.velocity_std_mps
    believed = {name: getattr(one.parameters, name) * velocity_std_mps / stated for name in STATED}
    told = replace(one, parameters=one.parameters.model_copy(update=believed)).in_drive(drive)
    generator = np.random.default_rng(SEED)
    squares = []
    for _ in range(DRAWS):
        estimate = told({**drive.signals, **drawn_gps(drive, velocity_std_mps, generator)})
        figures = error_figures(estimate, drive.sideslip_rad, drive.evaluated)
        squares.append(np.nan if figures.rmse_deg is None else figures.rmse_deg**2)
    return float(np.sqrt(np.mean(squares)))


def drawn_gps(
    drive: EvaluatedDrive, velocity_std_mps: float, generator: np.random.Generator
) -> dict[str, FloatArray]:
    """Return the true velocity with white noise at every fix, NaN between them."""
    every = SAMPLE_RATE_HZ // drive.scenario.sensors.gps.rate_hz
    fixes = np.arange(len(drive.time_s)) % every == 0
    noise = velocity_std_mps * generator.standard_normal((2, len(fixes)))
    return {
        "gps_vx_mps": np.where(fixes, drive.vx_mps + noise[0], np.nan),
        "gps_vy_mps": np.where(fixes, drive.vy_mps + noise[1], np.nan),
    }
