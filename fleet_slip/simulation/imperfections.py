"""What cars, sensors and roads have beyond the textbook's. Sources: `docs/simulator.md`."""

from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from fleet_slip.config import Config, ConfigT, added
from fleet_slip.vehicle.parameters import CarImperfections, VehicleParameters

Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Latency = Annotated[FiniteFloat, Field(ge=0, le=1)]
Bandwidth = Annotated[FiniteFloat, Field(ge=0, le=30)]
Turned = Annotated[FiniteFloat, Field(ge=-5, le=5)]


class SensorImperfections(Config):
    """Where sensors sit, how fast they follow (bandwidths; 0 is no limit), and further errors."""

    inertial_x_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """Of the inertial unit before the centre of gravity."""
    inertial_y_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """Of the inertial unit to the left of the centre of gravity."""
    inertial_roll_deg: Turned = 0.0
    """How far the unit is turned about the car's axis, left side up."""
    inertial_pitch_deg: Turned = 0.0
    """How far the unit is turned, front up."""
    inertial_yaw_deg: Turned = 0.0
    """How far the unit is turned to the left."""
    inertial_bandwidth_hz: Bandwidth = 0.0
    inertial_latency_s: Latency = 0.0
    steering_offset_deg: FiniteFloat = Field(default=0.0, ge=-30, le=30)
    """What the steering wheel's sensor reads straight ahead."""
    steering_latency_s: Latency = 0.0
    """Of the steering wheel's and the front wheels' angles."""
    wheel_angle_offset_fl_deg: Turned = 0.0
    wheel_angle_offset_fr_deg: Turned = 0.0
    wheel_angle_scale_error: FiniteFloat = Field(default=0.0, ge=-0.2, le=0.2)
    """Angle of a front wheel as measured over the true one, less one."""
    wheel_pulses_per_turn: int = Field(default=0, ge=0, le=1000)
    """0: the wheel speed is known at every instant."""
    wheel_pitch_error: FiniteFloat = Field(default=0.0, ge=0, le=0.1)
    """Standard deviation of a pulse's place on the wheel, over the distance of two pulses."""
    wheel_latency_s: Latency = 0.0
    label_offset_deg: Turned = 0.0
    """How far the reference sensor is turned."""
    label_bandwidth_hz: Bandwidth = 0.0
    label_latency_s: Latency = 0.0
    gps_latency_s: Latency = 0.0
    gps_heading_std_deg: NotNegative = 0.0
    """Of the heading that turns satellite velocity into the car's frame."""
    gps_velocity_std_mps: NotNegative = 0.0
    """Of the errors of velocity that last, beside the white noise."""
    gps_correlation_s: FiniteFloat = Field(default=10.0, ge=0.1)
    """Time constant of both errors."""


class RoadImperfections(Config):
    """A road that is not flat, even and calm. Slopes are in percent, as on road signs."""

    cross_slope_percent: FiniteFloat = Field(default=0.0, ge=-20, le=20)
    """Fall to the right that drains the road."""
    superelevation_percent: FiniteFloat = Field(default=0.0, ge=0, le=20)
    """Fall towards the inside of bends with a radius of 100 m or less, less in wider ones."""
    bank_std_percent: NotNegative = 0.0
    """Of the fall to the side along the track beside these two."""
    grade_std_percent: NotNegative = 0.0
    adhesion_std: FiniteFloat = Field(default=0.0, ge=0, le=0.3)
    """Relative change of adhesion along the track."""
    adhesion_split_std: FiniteFloat = Field(default=0.0, ge=0, le=0.3)
    """Relative difference of adhesion between left and right."""
    wind_mps: NotNegative = 0.0
    """Steady wind at the height of the car, from a direction of the drive's own."""
    gust_std_mps: NotNegative = 0.0


class Imperfections(Config):
    """Everything about one drive that is not as in the textbook."""

    car: CarImperfections = CarImperfections()
    sensors: SensorImperfections = SensorImperfections()
    road: RoadImperfections = RoadImperfections()


NONE = Imperfections()


class Range(Config):
    """A uniform distribution over any numbers."""

    min: FiniteFloat
    max: FiniteFloat

    @model_validator(mode="after")
    def _ordered(self) -> "Range":
        if self.min > self.max:
            raise ValueError(f"min {self.min} is above max {self.max}")
        return self

    def draw(self, generator: np.random.Generator) -> float:
        """Draw one number."""
        return float(generator.uniform(self.min, self.max))


class Uniform(Range):
    """A uniform distribution over positive numbers."""

    min: Positive
    max: Positive


WORN_STIFFNESS, WORN_RADIUS = 1.1, 0.98
"""Cornering stiffness and rolling radius of a tyre without tread, over those of a new one: 8 mm
less on 325 mm, and shorter blocks, which give way less (the scenario `tyres_worn`)."""


class ImperfectionRanges(Config):
    """From what each car's imperfections, and each drive's road, are drawn.

    Keys are fields of `CarImperfections`, `SensorImperfections` and `RoadImperfections`; others are
    zero. Cars and sensors keep theirs, the road is drawn anew.
    """

    load_position_m: Range | None = None
    """Where load sits, before the centre of gravity of the car without it; None: at that place."""
    tread_wear_per_100_days: Range | None = added(None)
    """Share of the tread that a car's tyres lose; new ones follow where none is left."""
    car: dict[str, Range] = Field(default={})
    sensors: dict[str, Range] = Field(default={})
    road: dict[str, Range] = Field(default={})

    @model_validator(mode="after")
    def _both_ends_can_be(self) -> "ImperfectionRanges":
        for end in ("min", "max"):
            for kind, ranges in (
                (CarImperfections, self.car),
                (SensorImperfections, self.sensors),
                (RoadImperfections, self.road),
            ):
                if strange := [name for name in ranges if name not in kind.model_fields]:
                    known = ", ".join(kind.model_fields)
                    raise ValueError(f"{strange[0]!r} is no imperfection. There are: {known}")
                kind.model_validate({name: getattr(one, end) for name, one in ranges.items()})
        return self

    @model_validator(mode="after")
    def _tread_does_not_grow(self) -> "ImperfectionRanges":
        if self.tread_wear_per_100_days and self.tread_wear_per_100_days.min < 0:
            raise ValueError("tread_wear_per_100_days: a tread does not grow")
        return self

    def loaded(
        self, vehicle: VehicleParameters, mass_kg: float, generator: np.random.Generator
    ) -> VehicleParameters:
        """Return the car loaded to a sprung mass. Raises `ConfigError` if it cannot be."""
        place = self.load_position_m
        return vehicle.with_sprung_mass(mass_kg, place.draw(generator) if place else None)

    def wear(self, of_car: np.random.Generator, days: int) -> tuple[float, float]:
        """Return what so many days have made of a car's stiffness and rolling radius: factors."""
        if self.tread_wear_per_100_days is None:
            return 1.0, 1.0
        worn = self.tread_wear_per_100_days.draw(of_car) * days / 100 % 1.0
        return 1.0 + (WORN_STIFFNESS - 1.0) * worn, 1.0 + (WORN_RADIUS - 1.0) * worn

    def draw(self, of_car: np.random.Generator, of_drive: np.random.Generator) -> Imperfections:
        """Draw the imperfections of a car from one generator, of a drive's road from another."""
        return Imperfections(
            car=_draw(CarImperfections, self.car, of_car),
            sensors=_draw(SensorImperfections, self.sensors, of_car),
            road=_draw(RoadImperfections, self.road, of_drive),
        )


def _draw(kind: type[ConfigT], ranges: dict[str, Range], generator: np.random.Generator) -> ConfigT:
    drawn = {}
    for name, field in kind.model_fields.items():
        if name in ranges:
            value = ranges[name].draw(generator)
            drawn[name] = round(value) if field.annotation is int else value
    return kind.model_validate(drawn)
