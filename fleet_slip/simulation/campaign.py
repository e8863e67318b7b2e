"""Campaigns: which cars drive where, how fast and how often, read from `configs/campaigns/*.toml`.

A drive depends on the campaign's seed and its own name, never on days, other drives or order.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from pydantic import Field, TypeAdapter, ValidationInfo, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.base import canonical_ascii, sha256_of
from fleet_slip.catalog.drive_sources import SCENARIO
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, load_config, load_toml
from fleet_slip.errors import ConfigError, UsageError
from fleet_slip.resources import Configs
from fleet_slip.simulation.drive_plans import (
    CarOnRoad,
    DriveDraw,
    FleetPlan,
    GridPlan,
    TrafficPlan,
    TrialPlan,
    configs_of,
)
from fleet_slip.simulation.imperfections import NONE, NotNegative, Positive
from fleet_slip.simulation.receivers import Receiver, Receivers
from fleet_slip.simulation.roads import SpeedProfile, random_generator, speed_profile, surface
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ, Distortion, Sensors
from fleet_slip.vehicle.batch import Surface

if TYPE_CHECKING:
    from fleet_slip.simulation.traffic import TrafficDrive

ROAD_SPACING_M = 1.0
"""Spacing of the points at which curvature and target speed are tabulated, in m."""


class PacePoint(Config):
    """Speed over that of the planned profile at one station; linear in between."""

    station_m: NotNegative
    factor: Positive


@dataclass(frozen=True, kw_only=True)
class DriveSpec(CarOnRoad):
    """Everything that determines one drive's bytes."""

    drive_id: str
    vehicle_id: str
    campaign: str
    day: date
    laps: float
    seed: int
    source: str = "simulated"
    receiver: Annotated[Receiver | None, Field(exclude_if=lambda one: one is None)] = None
    drawn_as: Annotated[str, Field(exclude_if=lambda name: not name)] = ""
    """The campaign whose car, road and noise this drive has, if it is not its own."""
    pace: Annotated[tuple[PacePoint, ...], Field(exclude=True)] = ()
    """Of a scenario: how its speed varies beside what the track asks for."""

    @cached_property
    def in_traffic(self) -> "TrafficDrive | None":
        """What highway-env decides of the drive, computed when it is asked for."""
        if self.traffic is None:
            return None
        from fleet_slip.simulation.traffic import drive_in_traffic  # noqa: PLC0415 - takes a second

        generator = self._drawn("traffic", self.drive_id)
        return drive_in_traffic(
            self.traffic, self.limits, self.speed_factor, ROAD_SPACING_M, generator
        )

    @property
    def profile(self) -> SpeedProfile:
        """The track and the speed along it within the limits, with the pace, before the factor."""
        if self.in_traffic:
            return self.in_traffic.profile
        planned = speed_profile(self.track, self.limits, ROAD_SPACING_M)
        if not self.pace:
            return planned
        stations = [point.station_m for point in self.pace]
        factors = [point.factor for point in self.pace]
        period = self.track.length_m if self.track.closed else None
        factor = np.interp(planned.station_m, stations, factors, period=period)
        return replace(planned, speed_mps=planned.speed_mps * factor)

    @cached_property
    def expected_rows(self) -> int:
        """Rows of the drive if the car holds its target speed."""
        if self.traffic:
            return math.ceil(self.traffic.duration_s * SAMPLE_RATE_HZ)
        time_s = self.profile.time_s(self.laps) / self.speed_factor
        return math.ceil(time_s * SAMPLE_RATE_HZ)

    def generator(self) -> np.random.Generator:
        """Return the generator of the drive's sensor noise, at its start."""
        return self._drawn("sensors", self.drive_id)

    def satellite_generator(self) -> np.random.Generator:
        """Return the generator of the satellite receiver's errors in the drive."""
        return self._drawn("satellites", self.drive_id)

    def _drawn(self, what: str, identity: str) -> np.random.Generator:
        own = identity.removeprefix(self.campaign)
        known_as = self.drawn_as + own if self.drawn_as else identity
        return random_generator(self.seed, what, known_as)

    def distortion(self) -> Distortion | None:
        """Return what the sensors make of the truth, at the drive's start; None where nothing."""
        if self.flaws == NONE:
            return None
        of_car = self._drawn("pulses", self.vehicle_id)
        return Distortion(self.flaws, of_car, self._drawn("gps", self.drive_id))

    def surface(self, station_m: FloatArray) -> Surface | None:
        """Return the road's surface at the stations of the profile."""
        of_track = random_generator(self.seed, "slopes", self.track.name)
        of_drive = self._drawn("weather", self.drive_id)
        track = self.in_traffic.profile.track if self.in_traffic else self.track
        return surface(self.flaws.road, track, station_m, of_track, of_drive)


@dataclass(frozen=True)
class Batch:
    """Whole drives of one day that become one Parquet file."""

    campaign: str
    day: date
    index: int
    drives: tuple[DriveSpec, ...]

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all that determines the batch's bytes, as canonical JSON."""
        digest = sha256_of(canonical_ascii(_BATCH.dump_python(self, mode="json")))
        scenarios = [drive for drive in self.drives if drive.source == SCENARIO]
        paces = [[point.model_dump() for point in drive.pace] for drive in scenarios]
        return sha256_of(f"{digest} {json.dumps(paces)}") if scenarios else digest


_BATCH = TypeAdapter(Batch)


class Campaign(Config):
    """A plan of drives over days, or what differs from its `base`; more days change no drive.

    A plan without a `kind` says what differs from that of the base, table by table.
    """

    name: Identifier
    description: str = Field(min_length=1)
    seed: int = Field(ge=0)
    first_day: date = Field(ge=date(1970, 1, 1), le=date(2099, 12, 31))
    number_of_days: int = Field(gt=0, le=10_000)
    drives_per_day: int = Field(gt=0, le=9999)
    laps: float = Field(gt=0, le=1000)
    rows_per_file: int = Field(gt=0, le=2_000_000)
    plan: Annotated[GridPlan | FleetPlan | TrafficPlan | TrialPlan, Field(discriminator="kind")]
    sensors: Sensors
    base: Annotated[Identifier | None, Field(exclude_if=lambda one: one is None)] = None
    receivers: Annotated[Receivers | None, Field(exclude_if=lambda one: one is None)] = None
    """Satellite receivers that log course and speed; None: none does."""

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, content: Any, info: ValidationInfo) -> Any:
        if not isinstance(content, dict) or not isinstance(content.get("base"), str):
            return content
        base = load_base("campaigns", content["base"], configs_of(info))
        if "base" in base:
            raise ValueError(f"the base {content['base']!r} has a base itself: take that one")
        plan = content.get("plan", {})
        if isinstance(plan, dict) and "kind" not in plan:
            plan = merged(base.get("plan", {}), plan)
        return {**base, **content, "plan": plan}

    @model_validator(mode="after")
    def _open_tracks_have_no_laps(self) -> Self:
        for track in self.plan.tracks:
            if self.laps > 1 and not track.closed:
                raise ValueError(f"laps is {self.laps}, but the track {track.name!r} is open")
        return self

    @property
    def digest(self) -> str:
        """SHA-256 over all that determines a day's bytes: all but how many days there are."""
        content = self.model_dump(mode="json", exclude={"number_of_days", "description"})
        return sha256_of(canonical_ascii(content))

    def days(self) -> tuple[date, ...]:
        """Return all days, in order."""
        return tuple(self.first_day + timedelta(days=day) for day in range(self.number_of_days))

    def chosen_days(self, count: int | None, through: date | None) -> tuple[date, ...]:
        """Return the first days, as many as asked for and up to a day. Raises `UsageError`."""
        days = self.days()
        chosen = tuple(
            day
            for day in days[: None if count is None else max(count, 0)]
            if through is None or day <= through
        )
        if not chosen:
            raise UsageError(
                f"no day is asked for: {self.name} lasts from {days[0]} to {days[-1]}."
            )
        return chosen

    def drives(self, day: date) -> tuple[DriveSpec, ...]:
        """Return the drives of a day, by name. Raises `ConfigError` for no such day."""
        days = self.days()
        if day not in days:
            raise ConfigError(
                f"{day} is not a day of the campaign {self.name!r}, which goes from {days[0]} to"
                f" {days[-1]}. Choose one of these, or raise number_of_days."
            )
        first = (day - self.first_day).days * self.drives_per_day
        return tuple(self._drive(day, first, i) for i in range(self.drives_per_day))

    def batches(self, day: date) -> tuple[Batch, ...]:
        """Return a day's files of about `rows_per_file` rows or fewer. Raises `ConfigError`."""
        packs = pack(self.drives(day), self.rows_per_file)
        return tuple(Batch(self.name, day, i, drives) for i, drives in enumerate(packs))

    def _drive(self, day: date, first: int, index: int) -> DriveSpec:
        plan, number = self.plan, first + index
        of_day, of_plan = f"-{day.isoformat()}-{index:04d}", f"-{plan.car(number):04d}"
        drive_id, vehicle_id = self.name + of_day, self.name + of_plan
        drawn_as = self.base or self.name
        assignment = plan.assignment(
            DriveDraw(
                number,
                self.sensors,
                random_generator(self.seed, "car", drawn_as + of_plan),
                random_generator(self.seed, "drive", drawn_as + of_day),
                (day - self.first_day).days,
            )
        )
        receiver = None
        if self.receivers:
            receiver = self.receivers.draw(
                random_generator(self.seed, "receiver", drawn_as + of_plan)
            )
        return DriveSpec(
            drive_id=drive_id,
            vehicle_id=vehicle_id,
            campaign=self.name,
            day=day,
            laps=self.laps,
            seed=self.seed,
            **vars(assignment),
            receiver=receiver,
            drawn_as=self.base or "",
        )


def load_base(kind: str, name: str, configs: Configs) -> dict[str, Any]:
    """Return the content of a base's file. Raises `ValueError` if there is none."""
    try:
        return load_toml(configs.find(kind, name))
    except ConfigError as error:
        raise ValueError(str(error)) from None


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the base with changes; tables are merged key by key, all else is replaced."""
    both = dict(base)
    for key, value in changes.items():
        tables = isinstance(value, dict) and isinstance(both.get(key), dict)
        both[key] = merged(both[key], value) if tables else value
    return both


def pack(drives: Sequence[DriveSpec], rows_per_file: int) -> list[tuple[DriveSpec, ...]]:
    """Split drives, in their order, evenly into as few runs as have about so many rows or fewer."""
    ends = np.cumsum([drive.expected_rows for drive in drives])
    middles = (ends + np.append(0, ends[:-1])) / 2
    files = math.ceil(ends[-1] / rows_per_file)
    file_of_drive = (middles * files / ends[-1]).astype(int)
    return [
        tuple(drive for _, drive in run)
        for _, run in groupby(zip(file_of_drive, drives, strict=True), key=itemgetter(0))
    ]


def load_campaign(name_or_path: str, configs: Configs) -> Campaign:
    """Read a campaign by name or path. Raises `ConfigError`."""
    return load_config(configs.find("campaigns", name_or_path), Campaign, configs)
