"""Plans of a campaign: how each drive gets a car, a road and a speed, from a grid or at random."""

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
    """Load a config that another one names, from the `Configs` of the validation context."""

    def resolve(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return load(value, configs_of(info))
        except ConfigError as error:
            raise ValueError(str(error)) from None

    return BeforeValidator(resolve)


def configs_of(info: ValidationInfo) -> Configs:
    """Return the configuration files of the validation context."""
    if not isinstance(info.context, Configs):
        raise TypeError("validate this config with `Configs` as context: it names other configs")
    return info.context


NamedTrack = Annotated[Track, load_by_name(load_track)]
NamedVehicle = Annotated[VehicleParameters, load_by_name(load_vehicle)]
NotEmpty = Field(min_length=1)


def _require_road(name: str) -> str:
    from fleet_slip.simulation.traffic import require_road  # noqa: PLC0415 - imports highway-env

    return require_road(name)


RoadWithTraffic = Annotated[str, AfterValidator(_require_road)]


class Traffic(Config):
    """A drive among other cars on roads of highway-env, which take turns."""

    roads: tuple[RoadWithTraffic, ...] = NotEmpty
    duration_s: FiniteFloat = Field(gt=0, le=600)
    other_cars: int = Field(alias="others", ge=0, le=50)
    """Approximate number of other cars."""
    decisions_hz: int = Field(default=10, ge=10, le=15)

    @property
    def track(self) -> Track:
        """Placeholder for the track, until highway-env has chosen the path."""
        return Track(
            name="_".join(dict.fromkeys(self.roads)),
            description=f"Traffic on {', '.join(self.roads)} in highway-env",
            closed=False,
            segments=(Segment(length_m=1000.0, curvature_1pm=(0.0, 0.0)),),
        )


def _placeholder_track(name: Any) -> Any:
    return Traffic(roads=(name,), duration_s=1.0, others=0).track if isinstance(name, str) else name


@dataclass(frozen=True)
class CarOnRoad:
    """A car on a road at a speed. Field names and values are part of a batch's digest."""

    vehicle: VehicleParameters
    sensors: Sensors
    track: Track
    adhesion: float
    limits: SpeedLimits
    speed_factor: float
    script: Annotated[tuple[Manoeuvre, ...], Field(exclude_if=lambda script: not script)] = ()
    """Manoeuvres. Empty ones are not part of the digest, which older campaigns have without."""
    flaws: Annotated[Imperfections, Field(exclude_if=lambda flaws: flaws == NONE)] = NONE
    """Imperfections, not part of the digest if there are none."""
    traffic: Annotated[Traffic | None, Field(exclude_if=lambda traffic: traffic is None)] = None
    """Traffic that highway-env drives in; None: the drive follows the track."""


@dataclass(frozen=True)
class DriveDraw:
    """Inputs of a plan for one drive."""

    index: int
    """Number of the drive in the campaign."""
    sensors: Sensors
    car_rng: np.random.Generator
    drive_rng: np.random.Generator
    days: int = 0
    """Days since the campaign's first."""


class Plan(Config):
    """Base of all plans. Acceleration and braking are limits on a road with μ = 1."""

    vehicles: tuple[NamedVehicle, ...] = NotEmpty
    tracks: tuple[NamedTrack, ...] = NotEmpty
    acceleration_mps2: Positive
    braking_mps2: Positive
    top_speed_mps: Positive

    def limits(
        self, lateral_mps2: float, acceleration: float = 1.0, braking: float = 1.0
    ) -> SpeedLimits:
        """Return the speed limits at a planned lateral acceleration, and factors of the others."""
        return SpeedLimits(
            lateral_mps2=lateral_mps2,
            acceleration_mps2=self.acceleration_mps2 * acceleration,
            braking_mps2=self.braking_mps2 * braking,
            top_speed_mps=self.top_speed_mps,
        )


class GridPlan(Plan):
    """Every combination of the lists, repeated.

    The stride is 1/φ of the number of combinations, with φ the golden ratio, so that any run of
    drives is spread evenly. Speeds are planned for μ = 1: the driver does not see the adhesion.
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

    def _combination(self, index: int) -> int:
        """Return the combination of a drive, as an index in C order."""
        count = math.prod(map(len, self._axes))
        stride = round(count / GOLDEN_RATIO)
        while math.gcd(stride, count) > 1:
            stride += 1
        return index * stride % count

    def car(self, index: int) -> int:
        """Return the number of a drive's car: one for each vehicle and mass."""
        return self._combination(index) // math.prod(map(len, self._axes[2:]))

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Return the car and the road of a drive."""
        index = np.unravel_index(self._combination(drawn.index), [len(axis) for axis in self._axes])
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
    """Standard deviations of sensor biases between cars."""

    acceleration_mps2: NotNegative
    yaw_rate_rad_s: NotNegative

    def draw(self, sensors: Sensors, generator: np.random.Generator) -> Sensors:
        """Draw the sensors of a car, with biases around those of the given sensors."""
        ax, ay, yaw_rate = generator.standard_normal(3).tolist()
        return sensors.model_copy(
            update={
                "ax_bias_mps2": sensors.ax_bias_mps2 + self.acceleration_mps2 * ax,
                "ay_bias_mps2": sensors.ay_bias_mps2 + self.acceleration_mps2 * ay,
                "yaw_rate_bias_rad_s": sensors.yaw_rate_bias_rad_s + self.yaw_rate_rad_s * yaw_rate,
            }
        )


class DrawnPlan(Plan):
    """A plan whose cars and drives are drawn at random."""

    sensor_bias_std: SensorBiases
    """Biases of all cars; in trials, of the other cars."""
    imperfections: ImperfectionRanges | None = added(None)
    """None: cars, sensors and roads are ideal."""


class FleetPlan(DrawnPlan):
    """Different cars take turns, on roads and at speeds that are drawn for every drive.

    Model, load, tyres and biases are drawn once for each car. `friction_use` is the planned lateral
    acceleration over μ g.
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

    def car(self, index: int) -> int:
        """Return the number of a drive's car."""
        return index % self.cars

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Draw a car with worn tyres, and its drive."""
        car_rng, drive_rng = drawn.car_rng, drawn.drive_rng
        vehicle = self.vehicles[car_rng.integers(len(self.vehicles))]
        mass_kg = vehicle.body.sprung_mass_kg * self.load.draw(car_rng)
        stiffness, radius = self.tyre_stiffness.draw(car_rng), self.tyre_radius.draw(car_rng)
        sensors = self.sensor_bias_std.draw(drawn.sensors, car_rng)
        track = self.tracks[drive_rng.integers(len(self.tracks))]
        adhesion = self.adhesion.draw(drive_rng)
        lateral_mps2 = self.friction_use.draw(drive_rng) * adhesion * GRAVITY_MPS2
        speed_factor = self.speed_factor.draw(drive_rng)
        ranges = self.imperfections or ImperfectionRanges()
        vehicle = ranges.loaded(vehicle, mass_kg, car_rng)
        flaws = ranges.draw(car_rng, drive_rng)
        stiffer, smaller = ranges.wear(car_rng, drawn.days)
        return CarOnRoad(
            vehicle=vehicle.with_tyres(
                stiffness_factor=stiffness * stiffer, rolling_radius_factor=radius * smaller
            ),
            sensors=sensors,
            track=track,
            adhesion=adhesion,
            limits=self.limits(lateral_mps2, adhesion, adhesion),
            speed_factor=speed_factor,
            flaws=flaws,
        )


class TrafficPlan(FleetPlan):
    """A fleet in traffic: each drive is on a road of highway-env among other cars.

    `tracks` names the roads. `speed_factor` is the desired speed over the limit of road and plan.
    """

    kind: Literal["traffic"]  # type: ignore[assignment]
    tracks: tuple[Annotated[Track, BeforeValidator(_placeholder_track)], ...] = NotEmpty
    duration_s: Uniform
    other_cars: Uniform = Field(alias="others")
    """Number of other cars."""
    decisions_hz: int = Field(default=10, ge=10, le=15)
    """Rate of highway-env's decisions."""

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Draw a car and its drive, then its duration and the number of other cars."""
        alone = super().assignment(drawn)
        traffic = Traffic(
            roads=(alone.track.name,),
            duration_s=self.duration_s.draw(drawn.drive_rng),
            others=round(self.other_cars.draw(drawn.drive_rng)),
            decisions_hz=self.decisions_hz,
        )
        return replace(alone, traffic=traffic)


class Drivers(Config):
    """Differences between drivers: line, wandering about the line, and speed."""

    cut: Range
    """Distance by which bends are cut, over the smallest radius of the road's class."""
    wander_m: Range
    """Standard deviation of the offset from the line."""
    acceleration_mps2: Uniform
    """Acceleration on a road with μ = 1; proportional to μ."""
    braking_mps2: Uniform
    top_speed: Uniform
    """Top speed over that of the road's class."""

    def line(self, road: Track, kind: str, generator: np.random.Generator) -> Track:
        """Draw the line of a driver along a road of a class."""
        cut_m = self.cut.draw(generator) * CLASSES[kind].radius_m[0]
        spacing_m = WANDER_S * CLASSES[kind].top_speed_mps
        return driven_line(road, cut_m, self.wander_m.draw(generator), spacing_m, generator)

    def limits(
        self, kind: str, adhesion: float, friction_use: float, generator: np.random.Generator
    ) -> SpeedLimits:
        """Draw the speed limits of a driver who sees the adhesion."""
        return SpeedLimits(
            lateral_mps2=friction_use * adhesion * GRAVITY_MPS2,
            acceleration_mps2=self.acceleration_mps2.draw(generator) * adhesion,
            braking_mps2=self.braking_mps2.draw(generator) * adhesion,
            top_speed_mps=self.top_speed.draw(generator) * CLASSES[kind].top_speed_mps,
        )


TEST_CAR = 0
"""Number of the car under test."""


class Mixture(Uniform):
    """With a probability the usual value or range, otherwise a uniform distribution."""

    usual: NotNegative | Uniform
    share: float = Field(ge=0, le=1)
    """Probability of `usual`."""

    def draw(self, generator: np.random.Generator) -> float:
        """Draw one number. The generator advances by the same amount in both cases."""
        chosen, other = generator.random(), super().draw(generator)
        usual = self.usual.draw(generator) if isinstance(self.usual, Uniform) else self.usual
        return usual if chosen < self.share else other


class Manoeuvres(Config):
    """Number and severity of a drive's manoeuvres."""

    per_km: Mixture
    friction_use: Uniform
    """Planned lateral acceleration, or braking, over μ g."""
    duration_s: Uniform
    period_s: Uniform
    """Period of a slalom."""

    def draw(
        self, track: Track, adhesion: float, generator: np.random.Generator
    ) -> tuple[Manoeuvre, ...]:
        """Draw the manoeuvres of a drive: kinds, stations and sides at random."""
        count = generator.poisson(self.per_km.draw(generator) * track.length_m / 1000)
        return tuple(self._manoeuvre(track, adhesion, generator) for _ in range(count))

    def _manoeuvre(
        self, track: Track, adhesion: float, generator: np.random.Generator
    ) -> Manoeuvre:
        side = 1.0 if generator.random() < 0.5 else -1.0
        return Manoeuvre(
            kind=KINDS[generator.integers(len(KINDS))],
            station_m=float(generator.uniform(0, track.length_m)),
            duration_s=self.duration_s.draw(generator),
            strength_mps2=side * self.friction_use.draw(generator) * adhesion * GRAVITY_MPS2,
            period_s=self.period_s.draw(generator),
        )


class TrialPlan(DrawnPlan):
    """Trials of one car on all roads, at all speeds and loads, with some drives of other cars.

    The first vehicle is under test. The planned lateral acceleration is limited to a share of the
    road's friction; above 1 the driver overestimates it. Load and wear are drawn for every drive,
    all other imperfections of a car once for each car.
    """

    kind: Literal["trials"]
    other_every: int = Field(ge=2)
    """One drive of this many is of another car."""
    other_cars: int = Field(alias="others", gt=0)
    """Number of other cars, which take turns."""
    load: Mixture
    tyre_stiffness: Mixture
    tyre_radius: Mixture
    noise: Mixture
    """Bias and noise of accelerometer and gyroscope over those of `sensors`."""
    adhesion: Mixture
    lateral_mps2: Mixture
    friction_use: Uniform
    acceleration: Uniform
    """Acceleration over `acceleration_mps2`."""
    braking: Uniform
    """Braking over `braking_mps2`."""
    manoeuvres: Manoeuvres
    load_kg: Annotated[Mixture | None, Field(exclude_if=lambda kg: kg is None)] = None
    """Additional load at `imperfections.load_position_m`."""
    tyre_wear_days: Annotated[NotNegative, Field(exclude_if=lambda days: days == 0)] = 0.0
    """Maximum age of the tyres."""
    drivers: Annotated[Drivers | None, Field(exclude_if=lambda drivers: drivers is None)] = None
    """Drivers with individual lines and speeds, on roads of a class."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        ranges = self.imperfections or ImperfectionRanges()
        if (self.load_kg is None) != (ranges.load_position_m is None):
            raise ValueError("give both load_kg and imperfections.load_position_m, or neither")
        if self.tyre_wear_days and ranges.tread_wear_per_100_days is None:
            raise ValueError("tyre_wear_days needs imperfections.tread_wear_per_100_days")
        if self.drivers and (other := [t.name for t in self.tracks if road_class(t) is None]):
            raise ValueError(f"drivers need roads of a class, such as country_17, not {other[0]}")
        return self

    def car(self, index: int) -> int:
        """Return the number of a drive's car; `TEST_CAR` is the one under test."""
        turn, position = divmod(index, self.other_every)
        is_test = position < self.other_every - 1
        return TEST_CAR if is_test else 1 + turn % self.other_cars

    def assignment(self, drawn: DriveDraw) -> CarOnRoad:
        """Draw a car and its drive, in a fixed order."""
        sensors, car_rng, drive_rng = drawn.sensors, drawn.car_rng, drawn.drive_rng
        vehicle = self.vehicles[0]
        if self.car(drawn.index) != TEST_CAR:
            vehicle = self.vehicles[car_rng.integers(len(self.vehicles))]
            sensors = self.sensor_bias_std.draw(sensors, car_rng)
        track = self.tracks[drive_rng.integers(len(self.tracks))]
        adhesion = self.adhesion.draw(drive_rng)
        friction = self.friction_use.draw(drive_rng) * adhesion * GRAVITY_MPS2
        lateral_mps2 = min(self.lateral_mps2.draw(drive_rng), friction)
        acceleration, braking = self.acceleration.draw(drive_rng), self.braking.draw(drive_rng)
        limits = self.limits(lateral_mps2, acceleration, braking)
        loaded_kg = vehicle.body.sprung_mass_kg * self.load.draw(drive_rng)
        vehicle = vehicle.with_sprung_mass(loaded_kg).with_tyres(
            stiffness_factor=self.tyre_stiffness.draw(drive_rng),
            rolling_radius_factor=self.tyre_radius.draw(drive_rng),
        )
        sensors = _with_noise(sensors, self.noise.draw(drive_rng))
        script = self.manoeuvres.draw(track, adhesion, drive_rng)
        kind = road_class(track)
        if self.drivers and kind:
            use = lateral_mps2 / (adhesion * GRAVITY_MPS2)
            limits = self.drivers.limits(kind, adhesion, use, drive_rng)
            track = self.drivers.line(track, kind, drive_rng)
        ranges = self.imperfections or ImperfectionRanges()
        return CarOnRoad(
            vehicle=self._worn(vehicle, ranges, drive_rng),
            sensors=sensors,
            track=track,
            adhesion=adhesion,
            limits=limits,
            speed_factor=1.0,
            script=script,
            flaws=ranges.draw(car_rng, drive_rng),
        )

    def _worn(
        self, vehicle: VehicleParameters, ranges: ImperfectionRanges, generator: np.random.Generator
    ) -> VehicleParameters:
        """Return the car with the additional load and the worn tyres of a drive."""
        if self.load_kg:
            mass_kg = vehicle.body.sprung_mass_kg + self.load_kg.draw(generator)
            vehicle = ranges.loaded(vehicle, mass_kg, generator)
        if not self.tyre_wear_days:
            return vehicle
        days = round(generator.uniform(0, self.tyre_wear_days))
        stiffer, smaller = ranges.wear(generator, days)
        return vehicle.with_tyres(stiffness_factor=stiffer, rolling_radius_factor=smaller)


def _with_noise(sensors: Sensors, factor: float) -> Sensors:
    """Scale bias and noise of accelerometer and gyroscope."""
    names = (
        "ax_bias_mps2",
        "ay_bias_mps2",
        "acceleration_std_mps2",
        "yaw_rate_bias_rad_s",
        "yaw_rate_std_rad_s",
    )
    return sensors.model_copy(update={name: getattr(sensors, name) * factor for name in names})
