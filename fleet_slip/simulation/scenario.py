"""Scenarios: test drives that models are evaluated on, read from `configs/scenarios/*.toml`.

Each says in what it differs from its base; its drive has a source of its own, and trains none.
"""

import re
from collections.abc import Mapping
from datetime import date
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, ValidationInfo, model_validator

from fleet_slip.catalog.drive_sources import SCENARIO
from fleet_slip.catalog.signals import Identifier, load_signals
from fleet_slip.config import Config, load_config
from fleet_slip.resources import Configs
from fleet_slip.simulation.campaign import Batch, DriveSpec, PacePoint, load_base, merged
from fleet_slip.simulation.drive_plans import NamedTrack, NamedVehicle, Traffic, configs_of
from fleet_slip.simulation.imperfections import NONE, Imperfections, NotNegative, Positive
from fleet_slip.simulation.roads import SpeedLimits, Track
from fleet_slip.simulation.sensors import GPS_SIGNALS, Sensors
from fleet_slip.vehicle.parameters import VehicleParameters

DAY = date(2024, 4, 1)
"""The date that all scenario drives carry."""

NOT_INHERITED = frozenset({"name", "description", "paper", "base", "drive", "failures"})
"""What a scenario says of itself alone."""


class Failure(Config):
    """Sensors that fail for a while: `stuck` at the count of `from_s`, or `missing`, when read."""

    kind: Literal["stuck", "missing"]
    signals: tuple[Identifier, ...] = Field(min_length=1)
    from_s: NotNegative
    until_s: Positive | None = None
    """None: to the end of the drive."""

    @model_validator(mode="after")
    def _signals_are_measured(self, info: ValidationInfo) -> Self:
        if isinstance(info.context, Configs):
            measured = (*load_signals(info.context).inputs, *GPS_SIGNALS)
            for name in self.signals:
                if name not in measured:
                    raise ValueError(f"{name!r} cannot fail. Signals: {', '.join(measured)}")
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s {self.until_s} is not after from_s {self.from_s}")
        return self


class Scenario(Config):
    """One test drive, and what fails in it."""

    name: Identifier
    description: str = Field(min_length=1)
    paper: str | None = None
    """The figures and tables of the paper that show this situation; None goes beyond the paper."""
    base: Identifier | None = None
    drive: Identifier
    """Whose drive this is: its own, or that of the base if nothing but failures is added."""
    vehicle: NamedVehicle
    sprung_mass_kg: Positive | None = None
    """None: that of the vehicle's file."""
    load_position_m: FiniteFloat | None = None
    """Where the load beyond that sits, before the centre of gravity; None: at that place."""
    tyre_stiffness: Positive = 1.0
    """Cornering stiffness over that of the vehicle's file."""
    tyre_radius: Positive = 1.0
    """Rolling radius over that of the vehicle's file."""
    track: NamedTrack
    adhesion: Positive
    limits: SpeedLimits
    """Planned for a dry road whatever the road is: the driver does not see it."""
    pace: tuple[PacePoint, ...] = ()
    laps: Positive
    seed: int = Field(ge=0)
    sensors: Sensors
    imperfections: Imperfections = NONE
    """What car, sensors and road have beyond the textbook's."""
    failures: tuple[Failure, ...] = ()
    traffic: Annotated[Traffic | None, Field(exclude_if=lambda one: one is None)] = None
    """Where highway-env drives, in the place of the track."""

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, content: Any, info: ValidationInfo) -> Any:
        return _complete(content, (), info) if isinstance(content, dict) else content

    @model_validator(mode="after")
    def _pace_is_on_the_track(self) -> Self:
        stations = [point.station_m for point in self.pace]
        if stations != sorted(set(stations)):
            raise ValueError("the stations of pace must increase")
        if stations and stations[-1] >= self.track.length_m:
            raise ValueError(
                f"pace: {stations[-1]} m is beyond {self.track.name}, {self.track.length_m:.0f} m"
            )
        return self

    @model_validator(mode="after")
    def _load_has_a_mass(self) -> Self:
        if self.load_position_m is not None and self.sprung_mass_kg is None:
            raise ValueError("load_position_m needs a sprung_mass_kg")
        return self

    @property
    def drive_id(self) -> str:
        """Name of the drive in the logs. No campaign's drive can have it."""
        return f"{SCENARIO}-{self.drive}"

    @property
    def way(self) -> Track:
        """The track, or what stands for it where highway-env drives."""
        return self.traffic.track if self.traffic else self.track

    @property
    def car(self) -> VehicleParameters:
        """The car with the scenario's load and tyres."""
        tyred = self.vehicle.with_tyres(
            stiffness_factor=self.tyre_stiffness, rolling_radius_factor=self.tyre_radius
        )
        if self.sprung_mass_kg is None:
            return tyred
        return tyred.with_sprung_mass(self.sprung_mass_kg, self.load_position_m)

    def batch(self) -> Batch:
        """Return the drive as the simulation job takes it."""
        drive = DriveSpec(
            drive_id=self.drive_id,
            vehicle_id=self.drive_id,
            campaign=self.drive_id,
            day=DAY,
            vehicle=self.car,
            sensors=self.sensors,
            track=self.way,
            adhesion=self.adhesion,
            limits=self.limits,
            speed_factor=1.0,
            laps=self.laps,
            seed=self.seed,
            source=SCENARIO,
            flaws=self.imperfections,
            pace=self.pace,
            traffic=self.traffic,
        )
        return Batch(self.drive_id, DAY, 0, (drive,))


def _complete(
    content: Mapping[str, Any], derived: tuple[str, ...], info: ValidationInfo
) -> dict[str, Any]:
    """Fill in what a scenario takes from its base. Raises `ValueError`."""
    name, base = content.get("name"), content.get("base")
    if "drive" in content:
        raise ValueError("drive follows from the base and cannot be given")
    if base is None:
        return {**content, "drive": name}
    if base == name or base in derived:
        raise ValueError(f"the base {base!r} leads back to this scenario")
    inherited = load_base("scenarios", str(base), configs_of(info))
    inherited = _complete(inherited, (*derived, str(name)), info)
    changes = sorted(set(content) - NOT_INHERITED)
    if "failures" in content and changes:
        raise ValueError(
            f"a scenario with failures takes the drive of its base as it is, without "
            f"{', '.join(changes)}"
        )
    drive = inherited["drive"] if "failures" in content else name
    kept = {key: value for key, value in inherited.items() if key not in NOT_INHERITED}
    return {**merged(kept, content), "drive": drive}


def load_scenario(name_or_path: str, configs: Configs) -> Scenario:
    """Read a scenario by name or path. Raises `ConfigError`."""
    return load_config(configs.find("scenarios", name_or_path), Scenario, configs)


def load_scenarios(configs: Configs) -> tuple[Scenario, ...]:
    """Return all scenarios: the paper's first, in the order of its figures."""

    def place_in_paper(scenario: Scenario) -> tuple[bool, list[int], str]:
        numbers = [int(number) for number in re.findall(r"\d+", scenario.paper or "")]
        return scenario.paper is None, numbers, scenario.name

    scenarios = (load_scenario(name, configs) for name in configs.names("scenarios"))
    return tuple(sorted(scenarios, key=place_in_paper))
