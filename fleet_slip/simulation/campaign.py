"""Campaigns of simulated drives, read from `configs/campaigns/*.toml`.

A drive depends on the campaign's seed and its own name, not on the number of days, on other drives
or on their order.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, TypeAdapter, ValidationInfo, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.base import canonical_ascii, sha256_of
from fleet_slip.catalog.signals import SCENARIO, Identifier
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
from fleet_slip.simulation.roads import SpeedProfile, random_generator, speed_profile, surface
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ, Receiver, Receivers, Sensors, distort
from fleet_slip.vehicle.batch import Surface

ROAD_SPACING_M = 1.0
"""Spacing of the tables of curvature and target speed, in m."""


class PacePoint(Config):
    """Speed over that of the planned profile at a station; linear in between."""

    station_m: NotNegative
    factor: Positive


@dataclass(frozen=True, kw_only=True)
class DriveSpec(CarOnRoad):
    """A drive: everything that determines its bytes."""

    drive_id: str
    vehicle_id: str
    campaign: str
    day: date
    laps: float
    seed: int
    source: str = "simulated"
    receiver: Annotated[Receiver | None, Field(exclude_if=lambda receiver: receiver is None)] = None
    drawn_as: Annotated[str, Field(exclude_if=lambda name: not name)] = ""
    """Campaign that car, road and noise are drawn for; empty: `campaign`."""
    pace: Annotated[tuple[PacePoint, ...], Field(exclude=True)] = ()
    """Variation of a scenario's speed, in addition to the planned profile."""

    @cached_property
    def in_traffic(self) -> SpeedProfile | None:
        """Path and speed in traffic, as highway-env decides them; None without traffic."""
        if self.traffic is None:
            return None
        from fleet_slip.simulation.traffic import drive_in_traffic  # noqa: PLC0415 - imports highway-env

        generator = self.generator("traffic")
        return drive_in_traffic(
            self.traffic, self.limits, self.speed_factor, ROAD_SPACING_M, generator
        )

    @property
    def profile(self) -> SpeedProfile:
        """The track and the speed within the limits, with the pace, without the speed factor."""
        if self.in_traffic:
            return self.in_traffic
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
        """Rows of the drive at the target speed."""
        if self.traffic:
            return math.ceil(self.traffic.duration_s * SAMPLE_RATE_HZ)
        time_s = self.profile.time_s(self.laps) / self.speed_factor
        return math.ceil(time_s * SAMPLE_RATE_HZ)

    def generator(self, purpose: str, identity: str = "") -> np.random.Generator:
        """Return a new generator for a purpose, of the drive or of another identity."""
        identity = identity or self.drive_id
        if self.drawn_as:
            identity = self.drawn_as + identity.removeprefix(self.campaign)
        return random_generator(self.seed, purpose, identity)

    def distorted(self, truth: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the drive as its imperfect sensors measure it, before bias and noise."""
        if self.flaws == NONE:
            return truth
        car_rng = self.generator("pulses", self.vehicle_id)
        return distort(truth, self.flaws, car_rng, self.generator("gps"))

    def surface(self, station_m: FloatArray) -> Surface | None:
        """Return the surface of the road at the stations of the profile."""
        track_rng = random_generator(self.seed, "slopes", self.track.name)
        drive_rng = self.generator("weather")
        track = self.in_traffic.track if self.in_traffic else self.track
        return surface(self.flaws.road, track, station_m, track_rng, drive_rng)


@dataclass(frozen=True)
class Batch:
    """Whole drives of one day that are written to one Parquet file."""

    campaign: str
    day: date
    index: int
    drives: tuple[DriveSpec, ...]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the canonical JSON of everything that determines the batch's bytes."""
        content = _BATCH.dump_python(self, mode="json", by_alias=True)
        digest = sha256_of(canonical_ascii(content))
        scenarios = [drive for drive in self.drives if drive.source == SCENARIO]
        paces = [[point.model_dump() for point in drive.pace] for drive in scenarios]
        return sha256_of(f"{digest} {json.dumps(paces)}") if scenarios else digest


_BATCH = TypeAdapter(Batch)


class Campaign(Config):
    """A plan of drives over days, or the differences from a `base`. More days change no drive.

    A plan without a `kind` contains differences from the base's plan, table by table.
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
    base: Annotated[Identifier | None, Field(exclude_if=lambda base: base is None)] = None
    receivers: Annotated[Receivers | None, Field(exclude_if=lambda cars: cars is None)] = None
    """Satellite receivers of the cars, which log course and speed; None: no receivers."""

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, content: Any, info: ValidationInfo) -> Any:
        if not isinstance(content, dict) or not isinstance(content.get("base"), str):
            return content
        base = load_base("campaigns", content["base"], configs_of(info))
        if "base" in base:
            raise ValueError(
                f"the base {content['base']!r} has a base itself. Name that one instead."
            )
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
        """SHA-256 of everything that determines a day's bytes: all but number of days and text."""
        excluded = {"number_of_days", "description"}
        content = self.model_dump(mode="json", exclude=excluded, by_alias=True)
        return sha256_of(canonical_ascii(content))

    def days(self) -> tuple[date, ...]:
        """Return all days, in order."""
        return tuple(self.first_day + timedelta(days=day) for day in range(self.number_of_days))

    def chosen_days(self, count: int | None, through: date | None) -> tuple[date, ...]:
        """Return the first `count` days up to `through`. Raises `UsageError` if there are none."""
        days = self.days()
        chosen = tuple(
            day
            for day in days[: None if count is None else max(count, 0)]
            if through is None or day <= through
        )
        if not chosen:
            raise UsageError(
                f"these options select no day. {self.name} lasts from {days[0]} to {days[-1]}."
            )
        return chosen

    def drives(self, day: date) -> tuple[DriveSpec, ...]:
        """Return the drives of a day by name. Raises `ConfigError` outside the campaign."""
        days = self.days()
        if day not in days:
            raise ConfigError(
                f"{day} is not a day of the campaign {self.name!r}, which lasts from {days[0]} to"
                f" {days[-1]}. Choose one of these, or raise number_of_days."
            )
        first = (day - self.first_day).days * self.drives_per_day
        return tuple(self._drive(day, first, i) for i in range(self.drives_per_day))

    def batches(self, day: date) -> tuple[Batch, ...]:
        """Return a day's batches of about `rows_per_file` rows or fewer. Raises `ConfigError`."""
        packs = pack(self.drives(day), self.rows_per_file)
        return tuple(Batch(self.name, day, i, drives) for i, drives in enumerate(packs))

    def _drive(self, day: date, first: int, position: int) -> DriveSpec:
        plan, index, drawn_as = self.plan, first + position, self.base or self.name
        drive_suffix, car_suffix = f"-{day.isoformat()}-{position:04d}", f"-{plan.car(index):04d}"

        def generator(purpose: str, suffix: str) -> np.random.Generator:
            return random_generator(self.seed, purpose, drawn_as + suffix)

        assignment = plan.assignment(
            DriveDraw(
                index,
                self.sensors,
                generator("car", car_suffix),
                generator("drive", drive_suffix),
                (day - self.first_day).days,
            )
        )
        receivers = self.receivers
        return DriveSpec(
            drive_id=self.name + drive_suffix,
            vehicle_id=self.name + car_suffix,
            campaign=self.name,
            day=day,
            laps=self.laps,
            seed=self.seed,
            **vars(assignment),
            receiver=receivers.draw(generator("receiver", car_suffix)) if receivers else None,
            drawn_as=self.base or "",
        )


def load_base(kind: str, name: str, configs: Configs) -> dict[str, Any]:
    """Read the file of a base. Raises `ValueError` if it is missing."""
    try:
        return load_toml(configs.find(kind, name))
    except ConfigError as error:
        raise ValueError(str(error)) from None


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Apply changes to a base: tables are merged key by key, all other values are replaced."""
    both = dict(base)
    for key, value in changes.items():
        tables = isinstance(value, dict) and isinstance(both.get(key), dict)
        both[key] = merged(both[key], value) if tables else value
    return both


def pack(drives: tuple[DriveSpec, ...], rows_per_file: int) -> list[tuple[DriveSpec, ...]]:
    """Split drives in order into the fewest groups with about `rows_per_file` rows or fewer."""
    ends = np.cumsum([drive.expected_rows for drive in drives])
    middles = (ends + np.append(0, ends[:-1])) / 2
    files = math.ceil(ends[-1] / rows_per_file)
    file_of_drive = (middles * files / ends[-1]).astype(int)
    starts = np.flatnonzero(np.diff(file_of_drive, prepend=-1)).tolist()
    return [drives[a:b] for a, b in pairwise([*starts, len(drives)])]


def load_campaign(name_or_path: str, configs: Configs) -> Campaign:
    """Read a campaign by name or path. Raises `ConfigError` if it is missing or not valid."""
    return load_config(configs.find("campaigns", name_or_path), Campaign, configs)
