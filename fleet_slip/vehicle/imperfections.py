"""What a real car has beyond the textbook's; zero is without. Sources: `docs/simulator.md`."""

import math
from typing import Annotated

from pydantic import Field, FiniteFloat

from fleet_slip.config import Config
from fleet_slip.vehicle.dynamics import Traits
from fleet_slip.vehicle.parameters import AIR_DENSITY_KGPM3, VehicleParameters

Angle = Annotated[FiniteFloat, Field(ge=-5, le=5)]
RadiusError = Annotated[FiniteFloat, Field(ge=-0.1, le=0.1)]


class CarImperfections(Config):
    """One car's own departures from its parameters."""

    steering_lash_deg: FiniteFloat = Field(default=0.0, ge=0, le=30)
    """Free play of the steering wheel, from stop to stop."""
    steering_compliance_deg_per_kn: FiniteFloat = Field(default=0.0, ge=0, le=0.5)
    """How far the front wheels give way under the lateral force of their axle."""
    toe_front_deg: Angle = 0.0
    """Of each front wheel, positive where the wheels point inwards."""
    toe_rear_deg: Angle = 0.0
    thrust_angle_deg: Angle = 0.0
    """How far the rear axle is turned to the left."""
    radius_error_fl: RadiusError = 0.0
    """Rolling radius over that of the tyre, less one: pressure and wear of this wheel."""
    radius_error_fr: RadiusError = 0.0
    radius_error_rl: RadiusError = 0.0
    radius_error_rr: RadiusError = 0.0
    radius_loss_mm_per_kn: FiniteFloat = Field(default=0.0, ge=0, le=5)
    """How much shorter the rolling radius is under further load."""
    relaxation_length_m: FiniteFloat = Field(default=0.0, ge=0, le=2)
    """Way after which a tyre's lateral slip has built up to 63 %."""
    cold_stiffness: FiniteFloat = Field(default=0.0, ge=-0.5, le=0.5)
    """Cornering stiffness at the start of a drive over that of warm tyres, less one."""
    warm_up_s: FiniteFloat = Field(default=600.0, ge=1)
    """Time constant of its decay."""
    roll_gradient_deg_per_g: FiniteFloat = Field(default=0.0, ge=0, le=15)
    """Roll angle of the body per lateral acceleration: it tilts what is fixed to the body."""
    pitch_gradient_deg_per_g: FiniteFloat = Field(default=0.0, ge=0, le=15)
    """Pitch angle of the body per longitudinal acceleration."""
    side_force_area_m2: FiniteFloat = Field(default=0.0, ge=0)
    """Frontal area times the slope of the side force coefficient, per rad of air flow angle."""
    yawing_moment_volume_m3: FiniteFloat = Field(default=0.0, ge=0)
    """Frontal area times wheelbase times the slope of the yawing moment coefficient, per rad."""


PERFECT = CarImperfections()


def traits(vehicle: VehicleParameters, flaws: CarImperfections, sample_s: float) -> Traits:
    """Return what the equations need of a car's imperfections."""
    radius, body = vehicle.tyre.rolling_radius_m, vehicle.body
    toe_rear, thrust = math.radians(flaws.toe_rear_deg), math.radians(flaws.thrust_angle_deg)
    length_m = flaws.relaxation_length_m
    pressure = 0.5 * AIR_DENSITY_KGPM3
    return Traits(
        half_lash=math.radians(flaws.steering_lash_deg) / 2,
        compliance=math.radians(flaws.steering_compliance_deg_per_kn) / 1000,
        toe=math.radians(flaws.toe_front_deg),
        rear_left=thrust - toe_rear,
        rear_right=thrust + toe_rear,
        radius_fl=radius * (1 + flaws.radius_error_fl),
        radius_fr=radius * (1 + flaws.radius_error_fr),
        radius_rl=radius * (1 + flaws.radius_error_rl),
        radius_rr=radius * (1 + flaws.radius_error_rr),
        radius_loss=flaws.radius_loss_mm_per_kn * 1e-6,
        relaxes=1.0 if length_m else 0.0,
        inverse_relaxation=1 / length_m if length_m else 0.0,
        cold_stiffness=flaws.cold_stiffness,
        cooling=1 - sample_s / flaws.warm_up_s,
        wind_force=pressure * flaws.side_force_area_m2 / body.mass_kg,
        wind_moment=pressure * flaws.yawing_moment_volume_m3 / body.yaw_inertia_kgm2,
    )
