"""Trials: one car tested under all that it may meet, and other cars beside it."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_slip.config import Config
from fleet_slip.simulation.drive_plan import CarOnRoad, DrawnPlan, Drivers
from fleet_slip.simulation.imperfections import ImperfectionRanges, NotNegative, Uniform
from fleet_slip.simulation.manoeuvres import KINDS, Manoeuvre
from fleet_slip.simulation.roads import road_class
from fleet_slip.simulation.sensing.sensors import Sensors
from fleet_slip.simulation.track import SpeedLimits, Track
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, VehicleParameters

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

    def assignment(
        self,
        number: int,
        sensors: Sensors,
        of_car: np.random.Generator,
        of_drive: np.random.Generator,
    ) -> CarOnRoad:
        """Draw a car from one generator and its drive from another, in a fixed order."""
        vehicle = self.vehicles[0]
        if self.car(number) != TESTED:
            vehicle = self.vehicles[of_car.integers(len(self.vehicles))]
            sensors = self.sensor_bias_std.draw(sensors, of_car)
        track = self.tracks[of_drive.integers(len(self.tracks))]
        adhesion = self.adhesion.draw(of_drive)
        friction = self.friction_use.draw(of_drive) * adhesion * GRAVITY_MPS2
        lateral_mps2 = min(self.lateral_mps2.draw(of_drive), friction)
        limits = self._tempered(lateral_mps2, of_drive)
        vehicle = self._loaded(vehicle, of_drive)
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

    def _tempered(self, lateral_mps2: float, generator: np.random.Generator) -> SpeedLimits:
        limits = self.limits(lateral_mps2)
        return limits.model_copy(
            update={
                "acceleration_mps2": limits.acceleration_mps2 * self.acceleration.draw(generator),
                "braking_mps2": limits.braking_mps2 * self.braking.draw(generator),
            }
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

    def _loaded(
        self, vehicle: VehicleParameters, generator: np.random.Generator
    ) -> VehicleParameters:
        vehicle = vehicle.with_sprung_mass(vehicle.body.sprung_mass_kg * self.load.draw(generator))
        return vehicle.with_tyres(
            stiffness_factor=self.tyre_stiffness.draw(generator),
            rolling_radius_factor=self.tyre_radius.draw(generator),
        )


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
