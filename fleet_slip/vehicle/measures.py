"""Measured data of a car, from which a filter's vehicle is identified."""

from typing import TYPE_CHECKING, Self

from pydantic import Field, FiniteFloat

from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config

if TYPE_CHECKING:
    from fleet_slip.vehicle.parameters import VehicleParameters


class VehicleMeasures(Config):
    """Measured vehicle data. SI units."""

    name: Identifier = Field(default="car", exclude=True)
    mass_kg: FiniteFloat = Field(gt=0)
    """Total mass, with the driver."""
    front_axle_m: FiniteFloat = Field(gt=0)
    """Distance of the front axle from the centre of gravity."""
    rear_axle_m: FiniteFloat = Field(gt=0)
    track_m: FiniteFloat = Field(default=1.55, gt=0)
    height_m: FiniteFloat = Field(default=0.55, gt=0)
    """Height of the centre of gravity above the road."""
    rolling_radius_m: FiniteFloat = Field(default=0.315, gt=0)
    front_drive_share: FiniteFloat = Field(default=1.0, ge=0, le=1)
    """Share of the drive torque on the front axle."""

    @classmethod
    def of_vehicle(cls, car: "VehicleParameters") -> Self:
        """Return the measures of a vehicle."""
        return cls(
            name=car.name,
            mass_kg=car.body.mass_kg,
            front_axle_m=car.body.front_axle_m,
            rear_axle_m=car.body.rear_axle_m,
            track_m=(car.body.track_front_m + car.body.track_rear_m) / 2,
            height_m=car.body.height_m,
            rolling_radius_m=car.tyre.rolling_radius_m,
            front_drive_share=car.drivetrain.front_drive_share,
        )
