"""Scenarios: test drives for the evaluation of models, read from `configs/scenarios/*.toml`.

A scenario contains its differences from a base. Its drive has the source `scenario`, which training
excludes.
"""

import re
from collections.abc import Mapping
from datetime import date
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, ValidationInfo, model_validator

from fleet_slip.catalog.signals import SCENARIO, Identifier, load_signals
from fleet_slip.config import Config, load_config
from fleet_slip.resources import Configs
from fleet_slip.simulation.campaign import Batch, DriveSpec, PacePoint, load_base, merged
from fleet_slip.simulation.drive_plans import NamedTrack, NamedVehicle, Traffic, configs_of
from fleet_slip.simulation.imperfections import NONE, Imperfections, NotNegative, Positive
from fleet_slip.simulation.roads import SpeedLimits, Track
from fleet_slip.simulation.sensors import GPS_SIGNALS, Sensors
from fleet_slip.vehicle.parameters import VehicleParameters

DAY = date(2024, 4, 1)
"""Date of all scenario drives."""

NOT_INHERITED = frozenset({"name", "description", "paper", "base", "drive", "failures"})
"""Keys that a scenario does not inherit from its base."""


class Failure(Config):
    """A failure of sensors: `stuck` at the count of `from_s`, or `missing`."""

    kind: Literal["stuck", "missing"]
    signals: tuple[Identifier, ...] = Field(min_length=1)
    from_s: NotNegative
    until_s: Positive | None = None
    """End of the failure; None: the end of the drive."""

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
    """A test drive, and the failures of its sensors."""

    name: Identifier
    description: str = Field(min_length=1)
    paper: str | None = None
    """Figures and tables of the paper with this situation; None: not in the paper."""
    base: Identifier | None = None
    drive: Identifier
    """Scenario whose drive this is: itself, or the base if only failures differ."""
    vehicle: NamedVehicle
    sprung_mass_kg: Positive | None = None
    """Sprung mass including the load; None: that of the vehicle's file."""
    load_position_m: FiniteFloat | None = None
    """Position of the load before the empty car's centre of gravity; None: at it."""
    tyre_stiffness: Positive = 1.0
    """Cornering stiffness over that of the vehicle's file."""
    tyre_radius: Positive = 1.0
    """Rolling radius over that of the vehicle's file."""
    track: NamedTrack
    adhesion: Positive
    limits: SpeedLimits
    """Speed limits on a dry road: the driver does not see the adhesion."""
    pace: tuple[PacePoint, ...] = ()
    laps: Positive
    seed: int = Field(ge=0)
    sensors: Sensors
    imperfections: Imperfections = NONE
    """Imperfections of car, sensors and road."""
    failures: tuple[Failure, ...] = ()
    traffic: Annotated[Traffic | None, Field(exclude_if=lambda traffic: traffic is None)] = None
    """Traffic that highway-env drives in, instead of the track."""

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, content: Any, info: ValidationInfo) -> Any:
        return _complete(content, (), info) if isinstance(content, dict) else content

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        stations = [point.station_m for point in self.pace]
        if stations != sorted(set(stations)):
            raise ValueError("the stations of pace must increase")
        if stations and stations[-1] >= self.track.length_m:
            raise ValueError(
                f"pace: {stations[-1]} m is beyond {self.track.name}, {self.track.length_m:.0f} m"
            )
        if self.load_position_m is not None and self.sprung_mass_kg is None:
            raise ValueError("load_position_m needs a sprung_mass_kg")
        return self

    @property
    def drive_id(self) -> str:
        """Name of the drive in the logs, which no drive of a campaign can have."""
        return f"{SCENARIO}-{self.drive}"

    @property
    def way(self) -> Track:
        """The track, or its placeholder in traffic."""
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
        """Return the drive as a batch to simulate."""
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
    """Complete a scenario by the values of its base. Raises `ValueError` if it is not valid."""
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
            f"a scenario with failures uses the drive of its base unchanged: remove "
            f"{', '.join(changes)}"
        )
    drive = inherited["drive"] if "failures" in content else name
    inherited = {key: value for key, value in inherited.items() if key not in NOT_INHERITED}
    return {**merged(inherited, content), "drive": drive}


def load_scenario(name_or_path: str, configs: Configs) -> Scenario:
    """Read a scenario by name or path. Raises `ConfigError` if it is missing or not valid."""
    return load_config(configs.find("scenarios", name_or_path), Scenario, configs)


def load_scenarios(configs: Configs) -> tuple[Scenario, ...]:
    """Read all scenarios: first those of the paper, in the order of its figures."""

    def place_in_paper(scenario: Scenario) -> tuple[bool, list[int], str]:
        numbers = [int(number) for number in re.findall(r"\d+", scenario.paper or "")]
        return scenario.paper is None, numbers, scenario.name

    scenarios = (load_scenario(name, configs) for name in configs.names("scenarios"))
    return tuple(sorted(scenarios, key=place_in_paper))
