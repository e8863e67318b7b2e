"""Imperfections of cars, sensors and roads. Sources of the figures: `docs/simulator.md`."""

from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from fleet_slip.config import Config, ConfigT, added
from fleet_slip.vehicle.parameters import CarImperfections, VehicleParameters

Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Latency = Annotated[FiniteFloat, Field(ge=0, le=1)]
Bandwidth = Annotated[FiniteFloat, Field(ge=0, le=30)]
Angle = Annotated[FiniteFloat, Field(ge=-5, le=5)]


class SensorImperfections(Config):
    """Positions, lags and errors of sensors. A bandwidth of 0 is no limit."""

    inertial_x_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """Position of the inertial unit before the centre of gravity."""
    inertial_y_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """Position of the inertial unit to the left of the centre of gravity."""
    inertial_roll_deg: Angle = 0.0
    """Rotation of the unit about the longitudinal axis, left side up."""
    inertial_pitch_deg: Angle = 0.0
    """Rotation of the unit, front up."""
    inertial_yaw_deg: Angle = 0.0
    """Rotation of the unit to the left."""
    inertial_bandwidth_hz: Bandwidth = 0.0
    inertial_latency_s: Latency = 0.0
    steering_offset_deg: FiniteFloat = Field(default=0.0, ge=-30, le=30)
    """Reading of the steering wheel's sensor when the car drives straight ahead."""
    steering_latency_s: Latency = 0.0
    """Latency of the angles of steering wheel and front wheels."""
    wheel_angle_offset_fl_deg: Angle = 0.0
    wheel_angle_offset_fr_deg: Angle = 0.0
    wheel_angle_scale_error: FiniteFloat = Field(default=0.0, ge=-0.2, le=0.2)
    """Relative error of the measured angles of the front wheels."""
    wheel_pulses_per_turn: int = Field(default=0, ge=0, le=1000)
    """Pulses of a wheel's encoder; 0: the wheel speed is measured at every instant."""
    wheel_pitch_error: FiniteFloat = Field(default=0.0, ge=0, le=0.1)
    """Standard deviation of a pulse's position on the wheel, over the distance of two pulses."""
    wheel_latency_s: Latency = 0.0
    label_offset_deg: Angle = 0.0
    """Rotation of the reference sensor."""
    label_bandwidth_hz: Bandwidth = 0.0
    label_latency_s: Latency = 0.0
    gps_latency_s: Latency = 0.0
    gps_heading_std_deg: NotNegative = 0.0
    """Error of the heading that rotates satellite velocity into the car's frame."""
    gps_velocity_std_mps: NotNegative = 0.0
    """Correlated errors of the velocity, in addition to the white noise."""
    gps_correlation_s: FiniteFloat = Field(default=10.0, ge=0.1)
    """Time constant of both errors."""


class RoadImperfections(Config):
    """Slopes, uneven adhesion and wind. Slopes are in percent, as on road signs."""

    cross_slope_percent: FiniteFloat = Field(default=0.0, ge=-20, le=20)
    """Slope to the right that drains the road."""
    superelevation_percent: FiniteFloat = Field(default=0.0, ge=0, le=20)
    """Slope to the inside of bends with a radius up to 100 m; less in wider bends."""
    bank_std_percent: NotNegative = 0.0
    """Variation of the cross slope along the track, in addition to these two."""
    grade_std_percent: NotNegative = 0.0
    """Variation of the longitudinal slope along the track."""
    adhesion_std: FiniteFloat = Field(default=0.0, ge=0, le=0.3)
    """Relative variation of adhesion along the track."""
    adhesion_split_std: FiniteFloat = Field(default=0.0, ge=0, le=0.3)
    """Relative difference of adhesion between left and right."""
    wind_mps: NotNegative = 0.0
    """Steady wind at the height of the car; each drive draws its direction."""
    gust_std_mps: NotNegative = 0.0


class Imperfections(Config):
    """Imperfections of the car, the sensors and the road of one drive."""

    car: CarImperfections = CarImperfections()
    sensors: SensorImperfections = SensorImperfections()
    road: RoadImperfections = RoadImperfections()


NONE = Imperfections()


class Range(Config):
    """A uniform distribution."""

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
"""Cornering stiffness and rolling radius of a tyre without tread, over those of a new tyre: 8 mm
less on 325 mm, and shorter, stiffer blocks (the scenario `tyres_worn`)."""


class ImperfectionRanges(Config):
    """Ranges of the imperfections of cars, sensors and roads.

    Keys are fields of `CarImperfections`, `SensorImperfections` and `RoadImperfections`; without a
    range a field has its default. Those of cars and sensors are drawn once for each car, those of
    roads for each drive.
    """

    load_position_m: Range | None = None
    """Position of the load before the empty car's centre of gravity; None: at it."""
    tread_wear_per_100_days: Range | None = added(None)
    """Share of the tread that wears off. Worn-out tyres are replaced by new ones."""
    car: dict[str, Range] = Field(default={})
    sensors: dict[str, Range] = Field(default={})
    road: dict[str, Range] = Field(default={})

    @model_validator(mode="after")
    def _is_valid(self) -> "ImperfectionRanges":
        for config, ranges in (
            (CarImperfections, self.car),
            (SensorImperfections, self.sensors),
            (RoadImperfections, self.road),
        ):
            if unknown := [name for name in ranges if name not in config.model_fields]:
                names = ", ".join(config.model_fields)
                raise ValueError(f"{unknown[0]!r} is no imperfection. Choose from: {names}")
            config.model_validate({name: bounds.min for name, bounds in ranges.items()})
            config.model_validate({name: bounds.max for name, bounds in ranges.items()})
        if self.tread_wear_per_100_days and self.tread_wear_per_100_days.min < 0:
            raise ValueError("tread_wear_per_100_days must be at least 0: a tread does not grow")
        return self

    def loaded(
        self, vehicle: VehicleParameters, mass_kg: float, generator: np.random.Generator
    ) -> VehicleParameters:
        """Return the car loaded to a sprung mass. Raises `ConfigError` if it is impossible."""
        position_m = self.load_position_m
        return vehicle.with_sprung_mass(mass_kg, position_m.draw(generator) if position_m else None)

    def wear(self, car_rng: np.random.Generator, days: int) -> tuple[float, float]:
        """Draw the factors of stiffness and rolling radius after some days of wear."""
        if self.tread_wear_per_100_days is None:
            return 1.0, 1.0
        worn = self.tread_wear_per_100_days.draw(car_rng) * days / 100 % 1.0
        return 1.0 + (WORN_STIFFNESS - 1.0) * worn, 1.0 + (WORN_RADIUS - 1.0) * worn

    def draw(self, car_rng: np.random.Generator, drive_rng: np.random.Generator) -> Imperfections:
        """Draw the imperfections of car and sensors, and of the drive's road."""
        return Imperfections(
            car=_draw(CarImperfections, self.car, car_rng),
            sensors=_draw(SensorImperfections, self.sensors, car_rng),
            road=_draw(RoadImperfections, self.road, drive_rng),
        )


def _draw(kind: type[ConfigT], ranges: dict[str, Range], generator: np.random.Generator) -> ConfigT:
    drawn = {}
    for name, field in kind.model_fields.items():
        if name in ranges:
            value = ranges[name].draw(generator)
            drawn[name] = round(value) if field.annotation is int else value
    return kind.model_validate(drawn)
