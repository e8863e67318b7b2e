"""How a campaign chooses car, road and speed for each of its drives: from a grid, or at random.

Drivers who differ: the line that each takes along a road of a class, and how fast.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    ValidationInfo,
    model_validator,
)

from fleet_slip.config import Config, added
from fleet_slip.errors import ConfigError
from fleet_slip.resources import Configs
from fleet_slip.simulation.imperfections import (
    NONE,
    ImperfectionRanges,
    Imperfections,
    NotNegative,
    Positive,
    Range,
    Uniform,
)
from fleet_slip.simulation.roads import (
    CLASSES,
    KINDS,
    WANDER_S,
    Manoeuvre,
    Segment,
    SpeedLimits,
    Track,
    driven_line,
    load_track,
    road_class,
)
from fleet_slip.simulation.sensors import Sensors
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, VehicleParameters, load_vehicle

GOLDEN_RATIO = (1 + math.sqrt(5)) / 2


def load_by_name(load: Callable[[str, Configs], object]) -> BeforeValidator:
    """Let a config name another one, which is loaded from the `Configs` in the context."""

    def resolve(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return load(value, configs_of(info))
        except ConfigError as error:
            raise ValueError(str(error)) from None

    return BeforeValidator(resolve)


def configs_of(info: ValidationInfo) -> Configs:
    """Return the configuration files that a config which names others is validated with."""
    if not isinstance(info.context, Configs):
        raise TypeError("the validation of a config that names others needs `Configs` as context")
    return info.context


NamedTrack = Annotated[Track, load_by_name(load_track)]
NamedVehicle = Annotated[VehicleParameters, load_by_name(load_vehicle)]
NotEmpty = Field(min_length=1)


def _known_to_highway_env(name: str) -> str:
    from fleet_slip.simulation.traffic import require_road  # noqa: PLC0415 - takes a second

    try:
        return require_road(name)
    except ConfigError as error:
        raise ValueError(str(error)) from None


RoadWithTraffic = Annotated[str, AfterValidator(_known_to_highway_env)]


class Traffic(Config):
    """A drive among other cars: on which of highway-env's roads, in turns, and how long."""

    roads: tuple[RoadWithTraffic, ...] = NotEmpty
    duration_s: FiniteFloat = Field(gt=0, le=600)
    others: int = Field(ge=0, le=50)
    """About so many other cars."""
    decisions_hz: int = Field(default=10, ge=10, le=15)

    @property
    def track(self) -> Track:
        """What stands for the way of the drive before highway-env has chosen it."""
        return Track(
            name="_".join(dict.fromkeys(self.roads)),
            description=f"Traffic on {', '.join(self.roads)} in highway-env",
            closed=False,
            segments=(Segment(length_m=1000.0, curvature_1pm=(0.0, 0.0)),),
        )


def _way_among_cars(name: Any) -> Any:
    return Traffic(roads=(name,), duration_s=1.0, others=0).track if isinstance(name, str) else name


@dataclass(frozen=True)
class CarOnRoad:
    """One car on one road at one speed."""

    vehicle: VehicleParameters
    sensors: Sensors
    track: Track
    adhesion: float
    limits: SpeedLimits
    speed_factor: float
    script: Annotated[tuple[Manoeuvre, ...], Field(exclude_if=lambda script: not script)] = ()
    """Manoeuvres; a drive without any has the digest that it had before there were some."""
    flaws: Annotated[Imperfections, Field(exclude_if=lambda flaws: flaws == NONE)] = NONE
    """Not part of the digest where there are none: it is what it was before there were any."""
    traffic: Annotated[Traffic | None, Field(exclude_if=lambda one: one is None)] = None
    """Where highway-env drives; None: the track is known."""


@dataclass(frozen=True)
class DriveDraw:
    """From what a plan makes a drive: its number, its car's sensors, and generators of both.

    Since the campaign's beginning so many `days` have passed.
    """

    number: int
    sensors: Sensors
    of_car: np.random.Generator
    of_drive: np.random.Generator
    days: int = 0


class Plan(Config):
    """What every kind of plan states. The limits of speed are those on a road with μ = 1."""

    vehicles: tuple[NamedVehicle, ...] = NotEmpty
    tracks: tuple[NamedTrack, ...] = NotEmpty
    acceleration_mps2: Positive
    braking_mps2: Positive
    top_speed_mps: Positive

    def limits(self, lateral_mps2: float, adhesion: float = 1.0) -> SpeedLimits:
        """Return the limits at a planned lateral acceleration, all for the same adhesion."""
        return SpeedLimits(
            lateral_mps2=lateral_mps2,
            acceleration_mps2=self.acceleration_mps2 * adhesion,
            braking_mps2=self.braking_mps2 * adhesion,
            top_speed_mps=self.top_speed_mps,
        )


class GridPlan(Plan):
    """Every combination of the lists once, then again from the beginning.

    The stride is 1/φ of their number, φ the golden ratio: any run of drives spreads evenly. Speeds
    are planned for μ = 1: the driver does not see the road.
    """

    kind: Literal["grid"]
    mass_kg: tuple[Positive, ...] = NotEmpty
    adhesion: tuple[Positive, ...] = NotEmpty
    lateral_mps2: tuple[Positive, ...] = NotEmpty
    speed_factor: tuple[Positive, ...] = NotEmpty

    @property
    def _axes(self) -> tuple[tuple[Any, ...], ...]:
        return (
            self.vehicles,
            self.mass_kg,
            self.tracks,
            self.adhesion,
            self.lateral_mps2,
            self.speed_factor,
        )

    def _combination(self, number: int) -> int:
        """Return which combination the drive of this number takes, as an index in C order."""
        count = math.prod(map(len, self._axes))
        stride = round(count / GOLDEN_RATIO)
        while math.gcd(stride, count) > 1:
            stride += 1
        return number * stride % count

    def car(self, number: int) -> int:
        """Return the car that drives the drive of this number: one for each vehicle and mass."""
        return self._combination(number) // math.prod(map(len, self._axes[2:]))

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Return what the drive of this number is to be."""
        index = np.unravel_index(
            self._combination(drawn.number), [len(axis) for axis in self._axes]
        )
        vehicle, mass_kg, track, adhesion, lateral_mps2, speed_factor = (
            axis[i] for axis, i in zip(self._axes, index, strict=True)
        )
        return CarOnRoad(
            vehicle=vehicle.with_sprung_mass(mass_kg),
            sensors=drawn.sensors,
            track=track,
            adhesion=adhesion,
            limits=self.limits(lateral_mps2),
            speed_factor=speed_factor,
        )


class SensorBiases(Config):
    """Standard deviations of the biases from car to car."""

    acceleration_mps2: NotNegative
    yaw_rate_rad_s: NotNegative

    def draw(self, sensors: Sensors, generator: np.random.Generator) -> Sensors:
        """Return the sensors of one car, its biases drawn around the given ones."""
        ax, ay, yaw_rate = generator.standard_normal(3).tolist()
        return sensors.model_copy(
            update={
                "ax_bias_mps2": sensors.ax_bias_mps2 + self.acceleration_mps2 * ax,
                "ay_bias_mps2": sensors.ay_bias_mps2 + self.acceleration_mps2 * ay,
                "yaw_rate_bias_rad_s": sensors.yaw_rate_bias_rad_s + self.yaw_rate_rad_s * yaw_rate,
            }
        )


class DrawnPlan(Plan):
    """A plan whose cars and drives are drawn, with what is imperfect about both."""

    sensor_bias_std: SensorBiases
    """Of cars; in trials of the other ones."""
    imperfections: ImperfectionRanges | None = added(None)
    """None: cars, sensors and roads are those of the textbook."""


class FleetPlan(DrawnPlan):
    """Many different cars that take turns, each on roads and at speeds drawn for every drive.

    Model, load, tyres and biases are a car's own. The driver plans lateral acceleration over μ g by
    `friction_use`.
    """

    kind: Literal["fleet"]
    cars: int = Field(gt=0)
    load: Uniform
    """Sprung mass over that of the vehicle's file."""
    tyre_stiffness: Uniform
    """Cornering stiffness over that of the vehicle's file."""
    tyre_radius: Uniform
    """Rolling radius over that of the vehicle's file."""
    adhesion: Uniform
    friction_use: Uniform
    speed_factor: Uniform

    def car(self, number: int) -> int:
        """Return the car that drives the drive of this number."""
        return number % self.cars

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Draw a car with worn tyres from one generator, and its drive from another."""
        of_car, of_drive = drawn.of_car, drawn.of_drive
        vehicle = self.vehicles[of_car.integers(len(self.vehicles))]
        mass_kg = vehicle.body.sprung_mass_kg * self.load.draw(of_car)
        stiffness, radius = self.tyre_stiffness.draw(of_car), self.tyre_radius.draw(of_car)
        sensors = self.sensor_bias_std.draw(drawn.sensors, of_car)
        track = self.tracks[of_drive.integers(len(self.tracks))]
        adhesion = self.adhesion.draw(of_drive)
        lateral_mps2 = self.friction_use.draw(of_drive) * adhesion * GRAVITY_MPS2
        speed_factor = self.speed_factor.draw(of_drive)
        ranges = self.imperfections or ImperfectionRanges()
        vehicle = ranges.loaded(vehicle, mass_kg, of_car)
        flaws = ranges.draw(of_car, of_drive)
        stiffer, smaller = ranges.wear(of_car, drawn.days)
        return CarOnRoad(
            vehicle=vehicle.with_tyres(
                stiffness_factor=stiffness * stiffer, rolling_radius_factor=radius * smaller
            ),
            sensors=sensors,
            track=track,
            adhesion=adhesion,
            limits=self.limits(lateral_mps2, adhesion),
            speed_factor=speed_factor,
            flaws=flaws,
        )


class TrafficPlan(FleetPlan):
    """A fleet in traffic: each drive on one of highway-env's roads among other cars.

    `tracks` are the roads, and `speed_factor` is the wanted speed over what road or plan allow.
    """

    kind: Literal["traffic"]  # type: ignore[assignment]
    tracks: tuple[Annotated[Track, BeforeValidator(_way_among_cars)], ...] = NotEmpty
    duration_s: Uniform
    others: Uniform
    """Number of other cars."""
    decisions_hz: int = Field(default=10, ge=10, le=15)
    """How often highway-env decides."""

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Draw a car and its drive, then how long it takes and among how many cars."""
        one = super().assignment(drawn)
        traffic = Traffic(
            roads=(one.track.name,),
            duration_s=self.duration_s.draw(drawn.of_drive),
            others=round(self.others.draw(drawn.of_drive)),
            decisions_hz=self.decisions_hz,
        )
        return replace(one, traffic=traffic)


class Drivers(Config):
    """How drivers differ: the line, how they wander about it, and their temper."""

    cut: Range
    """How far ahead and behind a bend is rounded off, over the smallest radius of the class."""
    wander_m: Range
    acceleration_mps2: Uniform
    """On a road with μ = 1; less on others."""
    braking_mps2: Uniform
    top_speed: Uniform
    """Over that of the road's class."""

    def line(self, road: Track, kind: str, of_drive: np.random.Generator) -> Track:
        """Draw the line that a driver takes along a road of a class."""
        cut_m = self.cut.draw(of_drive) * CLASSES[kind].radius_m[0]
        every_m = WANDER_S * CLASSES[kind].top_speed_mps
        return driven_line(road, cut_m, self.wander_m.draw(of_drive), every_m, of_drive)

    def limits(
        self, kind: str, adhesion: float, friction_use: float, of_drive: np.random.Generator
    ) -> SpeedLimits:
        """Draw how fast a driver goes who sees the adhesion."""
        return SpeedLimits(
            lateral_mps2=friction_use * adhesion * GRAVITY_MPS2,
            acceleration_mps2=self.acceleration_mps2.draw(of_drive) * adhesion,
            braking_mps2=self.braking_mps2.draw(of_drive) * adhesion,
            top_speed_mps=self.top_speed.draw(of_drive) * CLASSES[kind].top_speed_mps,
        )


# Trials: one car tested under all that it may meet, and other cars beside it.

TESTED = 0
"""Number of the car under test."""


class Mostly(Uniform):
    """The usual value, or range, with a probability, and otherwise anything of a wider range."""

    usual: NotNegative | Uniform
    share: float = Field(ge=0, le=1)

    def draw(self, generator: np.random.Generator) -> float:
        """Draw one number; as many are drawn from the generator whichever is taken."""
        chosen, other = generator.random(), super().draw(generator)
        usual = self.usual.draw(generator) if isinstance(self.usual, Uniform) else self.usual
        return usual if chosen < self.share else other


class Manoeuvres(Config):
    """How many manoeuvres a drive has and how hard they are."""

    per_km: Mostly
    friction_use: Uniform
    """Planned lateral acceleration, or braking, over μ g."""
    duration_s: Uniform
    period_s: Uniform
    """Of a slalom."""

    def draw(
        self, track: Track, adhesion: float, generator: np.random.Generator
    ) -> tuple[Manoeuvre, ...]:
        """Draw the script of a drive: kinds, places and sides at random."""
        count = generator.poisson(self.per_km.draw(generator) * track.length_m / 1000)
        return tuple(self._one(track, adhesion, generator) for _ in range(count))

    def _one(self, track: Track, adhesion: float, generator: np.random.Generator) -> Manoeuvre:
        side = 1.0 if generator.random() < 0.5 else -1.0
        return Manoeuvre(
            kind=KINDS[generator.integers(len(KINDS))],
            station_m=float(generator.uniform(0, track.length_m)),
            duration_s=self.duration_s.draw(generator),
            strength_mps2=side * self.friction_use.draw(generator) * adhesion * GRAVITY_MPS2,
            period_s=self.period_s.draw(generator),
        )


class TrialPlan(DrawnPlan):
    """One car on every road, at every speed and load, and now and then one of other cars.

    The first vehicle is the tested one, mostly as usual. Lateral acceleration is planned up to a
    share of the road's friction; above one the driver expects more than there is. Load and wear are
    drawn for every drive, what else is imperfect about a car once for each.
    """

    kind: Literal["trials"]
    other_every: int = Field(ge=2)
    """Every so many drives one is of another car."""
    others: int = Field(gt=0)
    """Number of other cars, which take turns."""
    load: Mostly
    tyre_stiffness: Mostly
    tyre_radius: Mostly
    noise: Mostly
    """Bias and noise of the inertial sensors and the gyroscope over those of `sensors`."""
    adhesion: Mostly
    lateral_mps2: Mostly
    friction_use: Uniform
    acceleration: Uniform
    """Over `acceleration_mps2`."""
    braking: Uniform
    """Over `braking_mps2`."""
    manoeuvres: Manoeuvres
    load_kg: Annotated[Mostly | None, Field(exclude_if=lambda kg: kg is None)] = None
    """Further load, at the place that the imperfections have for load."""
    tyre_wear_days: Annotated[NotNegative, Field(exclude_if=lambda days: days == 0)] = 0.0
    """Tyres have been driven for up to so many days."""
    drivers: Annotated[Drivers | None, Field(exclude_if=lambda one: one is None)] = None
    """Who take lines and speeds of their own along roads of a class."""

    @model_validator(mode="after")
    def _is_of_use(self) -> Self:
        flaws = self.imperfections or ImperfectionRanges()
        if (self.load_kg is None) != (flaws.load_position_m is None):
            raise ValueError("load_kg and imperfections.load_position_m need each other")
        if self.tyre_wear_days and flaws.tread_wear_per_100_days is None:
            raise ValueError("tyre_wear_days needs imperfections.tread_wear_per_100_days")
        if self.drivers and (other := [t.name for t in self.tracks if road_class(t) is None]):
            raise ValueError(f"drivers take roads of a class, such as country_17, not {other[0]}")
        return self

    def car(self, number: int) -> int:
        """Return the car that drives the drive of this number; `TESTED` is the one under test."""
        turn, within = divmod(number, self.other_every)
        return TESTED if within < self.other_every - 1 else 1 + turn % self.others

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Draw a car from one generator and its drive from another, in a fixed order."""
        sensors, of_car, of_drive = drawn.sensors, drawn.of_car, drawn.of_drive
        vehicle = self.vehicles[0]
        if self.car(drawn.number) != TESTED:
            vehicle = self.vehicles[of_car.integers(len(self.vehicles))]
            sensors = self.sensor_bias_std.draw(sensors, of_car)
        track = self.tracks[of_drive.integers(len(self.tracks))]
        adhesion = self.adhesion.draw(of_drive)
        friction = self.friction_use.draw(of_drive) * adhesion * GRAVITY_MPS2
        lateral_mps2 = min(self.lateral_mps2.draw(of_drive), friction)
        limits = SpeedLimits(
            lateral_mps2=lateral_mps2,
            acceleration_mps2=self.acceleration_mps2 * self.acceleration.draw(of_drive),
            braking_mps2=self.braking_mps2 * self.braking.draw(of_drive),
            top_speed_mps=self.top_speed_mps,
        )
        loaded_kg = vehicle.body.sprung_mass_kg * self.load.draw(of_drive)
        vehicle = vehicle.with_sprung_mass(loaded_kg).with_tyres(
            stiffness_factor=self.tyre_stiffness.draw(of_drive),
            rolling_radius_factor=self.tyre_radius.draw(of_drive),
        )
        sensors = _noisier(sensors, self.noise.draw(of_drive))
        script = self.manoeuvres.draw(track, adhesion, of_drive)
        kind = road_class(track)
        if self.drivers and kind:
            use = lateral_mps2 / (adhesion * GRAVITY_MPS2)
            limits = self.drivers.limits(kind, adhesion, use, of_drive)
            track = self.drivers.line(track, kind, of_drive)
        ranges = self.imperfections or ImperfectionRanges()
        return CarOnRoad(
            vehicle=self._as_today(vehicle, ranges, of_drive),
            sensors=sensors,
            track=track,
            adhesion=adhesion,
            limits=limits,
            speed_factor=1.0,
            script=script,
            flaws=ranges.draw(of_car, of_drive),
        )

    def _as_today(
        self, vehicle: VehicleParameters, ranges: ImperfectionRanges, generator: np.random.Generator
    ) -> VehicleParameters:
        """Return the car with the further load and the worn tyres of a drive."""
        if self.load_kg:
            mass_kg = vehicle.body.sprung_mass_kg + self.load_kg.draw(generator)
            vehicle = ranges.loaded(vehicle, mass_kg, generator)
        if not self.tyre_wear_days:
            return vehicle
        days = round(generator.uniform(0, self.tyre_wear_days))
        stiffer, smaller = ranges.wear(generator, days)
        return vehicle.with_tyres(stiffness_factor=stiffer, rolling_radius_factor=smaller)


def _noisier(sensors: Sensors, factor: float) -> Sensors:
    """Return sensors whose accelerometer and gyroscope have so many times the bias and noise."""
    names = (
        "ax_bias_mps2",
        "ay_bias_mps2",
        "acceleration_std_mps2",
        "yaw_rate_bias_rad_s",
        "yaw_rate_std_rad_s",
    )
    return sensors.model_copy(update={name: getattr(sensors, name) * factor for name in names})
