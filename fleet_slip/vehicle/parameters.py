"""Vehicle parameters (`configs/vehicles/*.toml`), imperfections of cars, and state and controls.

Units are SI unless a name states another; signs follow ISO 8855. Sources of the figures are in
`docs/vehicle.md` and `docs/simulator.md`.
"""

import math
from typing import Annotated, NamedTuple, Self

from pydantic import Field, FiniteFloat, ValidationError, model_validator

from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, ConfigT, load_config, load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.resources import Configs

GRAVITY_MPS2 = 9.80665
MAX_STIFFNESS_PER_LOAD = 30.0
"""Limit of the slip stiffness over the load for a stable time step; real tyres are below."""

AIR_DENSITY_KGPM3 = 1.225
"""Density of air at 15 °C at sea level, in kg/m³."""


class Body(Config):
    """Masses and geometry. The whole car has the centre of gravity of its sprung mass."""

    sprung_mass_kg: FiniteFloat = Field(gt=0)
    unsprung_mass_front_kg: FiniteFloat = Field(gt=0)
    unsprung_mass_rear_kg: FiniteFloat = Field(gt=0)
    sprung_yaw_inertia_kgm2: FiniteFloat = Field(gt=0)
    front_axle_m: FiniteFloat = Field(gt=0)
    """Distance from the centre of gravity to the front axle."""
    rear_axle_m: FiniteFloat = Field(gt=0)
    """Distance from the centre of gravity to the rear axle."""
    height_m: FiniteFloat = Field(gt=0)
    """Height of the centre of gravity above the road."""
    track_front_m: FiniteFloat = Field(gt=0)
    """Track width of the front axle."""
    track_rear_m: FiniteFloat = Field(gt=0)
    """Track width of the rear axle."""
    reference_m: FiniteFloat = Field(default=0.0, exclude_if=lambda value: not value)
    """Position of the side-slip sensor before the centre of gravity. The sensor is fixed to the
    body: when the car is loaded, it stays at the empty car's centre of gravity."""

    @property
    def mass_kg(self) -> float:
        """Mass of the whole car, in kg."""
        return self.sprung_mass_kg + self.unsprung_mass_front_kg + self.unsprung_mass_rear_kg

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles, in m."""
        return self.front_axle_m + self.rear_axle_m

    @property
    def yaw_inertia_kgm2(self) -> float:
        """Yaw inertia in kg m²: of the sprung mass, and of the unsprung masses at the wheels."""
        front = self.front_axle_m**2 + self.track_front_m**2 / 4
        rear = self.rear_axle_m**2 + self.track_rear_m**2 / 4
        return (
            self.sprung_yaw_inertia_kgm2
            + self.unsprung_mass_front_kg * front
            + self.unsprung_mass_rear_kg * rear
        )


class Suspension(Config):
    """Load transfer, and the compliance of the axles."""

    front_roll_share: FiniteFloat = Field(ge=0, le=1)
    """Share of the front axle in the lateral load transfer."""
    roll_lag_s: FiniteFloat = Field(ge=0.01)
    """Time constant of the lateral load transfer."""
    pitch_lag_s: FiniteFloat = Field(ge=0.01)
    """Time constant of the longitudinal load transfer."""
    front_stiffness_factor: FiniteFloat = Field(gt=0)
    """Effective cornering stiffness of the front axle over that of its tyres."""
    rear_stiffness_factor: FiniteFloat = Field(gt=0)
    """Effective cornering stiffness of the rear axle over that of its tyres."""


class Tyre(Config):
    """Parameters of the brush tyre (`fleet_slip.vehicle.dynamics`) and its wheel."""

    rolling_radius_m: FiniteFloat = Field(gt=0)
    spin_inertia_kgm2: FiniteFloat = Field(gt=0)
    peak_stiffness_n: FiniteFloat = Field(gt=0)
    """Cornering stiffness c1 at the load c2, in N per unit of slip."""
    peak_stiffness_load_n: FiniteFloat = Field(gt=0)
    """Load c2 at which the cornering stiffness is largest."""
    longitudinal_stiffness_ratio: FiniteFloat = Field(gt=0)
    """Longitudinal slip stiffness over cornering stiffness."""
    friction: FiniteFloat = Field(gt=0)
    """Static friction coefficient at the nominal load, on a road of adhesion 1."""
    nominal_load_n: FiniteFloat = Field(gt=0)
    friction_load_sensitivity: FiniteFloat = Field(ge=0, le=0.2)
    """Relative decrease of friction per relative increase of load."""
    friction_decay_speed_mps: FiniteFloat = Field(gt=0)
    """Sliding speed at which the friction is halved."""
    rolling_resistance: FiniteFloat = Field(ge=0)

    @model_validator(mode="after")
    def _not_too_stiff(self) -> Self:
        stiffness = 2 * self.peak_stiffness_n / self.peak_stiffness_load_n
        stiffness *= max(1.0, self.longitudinal_stiffness_ratio)
        if stiffness > MAX_STIFFNESS_PER_LOAD:
            raise ValueError(
                f"the slip stiffness is {stiffness:.1f} times the load, more than the "
                f"{MAX_STIFFNESS_PER_LOAD} that can be simulated: lower peak_stiffness_n"
            )
        return self


class Steering(Config):
    """Steering, from the steering wheel to the rack."""

    ratio: FiniteFloat = Field(gt=0)
    """Steering wheel angle over the tangent of the mean road wheel angle."""
    lag_s: FiniteFloat = Field(ge=0.01)
    limit_rad: FiniteFloat = Field(gt=0)
    """Maximum angle of the steering wheel to each side."""


class Drivetrain(Config):
    """Distribution and limits of the tractive force."""

    front_drive_share: FiniteFloat = Field(ge=0, le=1)
    front_brake_share: FiniteFloat = Field(ge=0, le=1)
    lag_s: FiniteFloat = Field(ge=0.01)
    power_w: FiniteFloat = Field(gt=0)
    slip_control: FiniteFloat = Field(gt=0)
    """Slip at which anti-lock and traction control begin to reduce the torque of a wheel."""


class Aerodynamics(Config):
    """Air resistance."""

    drag_area_m2: FiniteFloat = Field(ge=0)
    """Drag coefficient times frontal area."""


class VehicleParameters(Config):
    """Parameters of a car, as in `configs/vehicles/*.toml`."""

    name: Identifier
    description: str = Field(min_length=1)
    body: Body
    suspension: Suspension
    tyre: Tyre
    steering: Steering
    drivetrain: Drivetrain
    aerodynamics: Aerodynamics

    def with_sprung_mass(self, mass_kg: float, load_position_m: float | None = None) -> Self:
        """Return the car with a load.

        Parameters
        ----------
        mass_kg
            Sprung mass including the load.
        load_position_m
            Position of the load before the empty car's centre of gravity, as a point mass. None:
            mass and yaw inertia grow in proportion, and the centre of gravity stays.

        Returns
        -------
        VehicleParameters
            The loaded car.

        Raises
        ------
        ConfigError
            If the loaded car is impossible.
        """
        body = self.body
        changes = {"sprung_mass_kg": mass_kg}
        if load_position_m is None:
            inertia = body.sprung_yaw_inertia_kgm2 * mass_kg / body.sprung_mass_kg
        else:
            load_kg = mass_kg - body.sprung_mass_kg
            shift_m = load_kg * load_position_m / (body.mass_kg + load_kg)
            # The parallel axis theorem, for the car without load and for the load.
            inertia = body.sprung_yaw_inertia_kgm2 + body.sprung_mass_kg * shift_m**2
            inertia += load_kg * (load_position_m - shift_m) ** 2
            changes["front_axle_m"] = body.front_axle_m - shift_m
            changes["rear_axle_m"] = body.rear_axle_m + shift_m
            changes["reference_m"] = body.reference_m - shift_m
        changes["sprung_yaw_inertia_kgm2"] = inertia
        return self.model_copy(update={"body": self._changed(self.body, changes)})

    def with_tyres(
        self, *, stiffness_factor: float = 1.0, rolling_radius_factor: float = 1.0
    ) -> Self:
        """Return the car with other tyres.

        Parameters
        ----------
        stiffness_factor
            Cornering stiffness over that of the present tyres.
        rolling_radius_factor
            Rolling radius over that of the present tyres.

        Raises
        ------
        ConfigError
            If the tyres cannot be simulated.
        """
        changes = {
            "peak_stiffness_n": self.tyre.peak_stiffness_n * stiffness_factor,
            "rolling_radius_m": self.tyre.rolling_radius_m * rolling_radius_factor,
        }
        return self.model_copy(update={"tyre": self._changed(self.tyre, changes)})

    def _changed(self, config: ConfigT, changes: dict[str, float]) -> ConfigT:
        try:
            return type(config).model_validate(config.model_dump() | changes)
        except ValidationError as error:
            reason = "; ".join(fault["msg"] for fault in error.errors())
            raise ConfigError(f"{self.name} with {changes}: {reason}.") from None


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
    def of_vehicle(cls, car: VehicleParameters) -> Self:
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


def load_vehicle(name_or_path: str, configs: Configs) -> VehicleParameters:
    """Read a car by name or path. Raises `ConfigError` if the file is missing or not valid."""
    return load_config(configs.find("vehicles", name_or_path), VehicleParameters)


def load_car(name_or_path: str, configs: Configs) -> VehicleParameters | VehicleMeasures:
    """Read a vehicle, or the measured data of a car from a file without a table `body`.

    Raises `ConfigError` if the file is missing or not valid.
    """
    file = configs.find("vehicles", name_or_path)
    if "body" in load_toml(file):
        return load_config(file, VehicleParameters)
    return load_config(file, VehicleMeasures)


def load_measures(name_or_path: str, configs: Configs) -> VehicleMeasures:
    """Read the measured data of a car, also from a vehicle. Raises as `load_car`."""
    car = load_car(name_or_path, configs)
    return car if isinstance(car, VehicleMeasures) else VehicleMeasures.of_vehicle(car)


class Constants(NamedTuple):
    """Constants of the equations for a car on a road, in SI units; divisions are precomputed."""

    mass: float
    inverse_mass: float
    yaw_inertia: float
    inverse_yaw_inertia: float
    front: float
    """Distance from the centre of gravity to the front axle."""
    rear: float
    half_track_width_front: float
    half_track_width_rear: float
    ackermann: float
    """Half of the front track width over the wheelbase."""
    static_front: float
    """Load of one front wheel at rest."""
    static_rear: float
    pitch_transfer: float
    """Load transfer of one wheel per longitudinal acceleration."""
    roll_transfer_front: float
    """Load transfer of one front wheel per lateral acceleration."""
    roll_transfer_rear: float
    inverse_roll_lag: float
    inverse_pitch_lag: float
    stiffness_front: float
    """Peak cornering stiffness of one effective front tyre."""
    stiffness_rear: float
    inverse_stiffness_load: float
    stiffness_ratio: float
    friction: float
    """Friction of tyre and road, extrapolated to no load."""
    friction_per_load: float
    """Decrease of friction per load."""
    inverse_decay_speed: float
    rolling_resistance: float
    radius: float
    inverse_radius: float
    inverse_spin_inertia: float
    steer_per_wheel: float
    """Tangent of the mean road wheel angle per angle of the steering wheel."""
    inverse_steering_lag: float
    steering_limit: float
    inverse_drive_lag: float
    drive_front: float
    """Force of one front wheel over the force of the drivetrain."""
    drive_rear: float
    brake_front: float
    brake_rear: float
    power_per_mass: float
    drag_per_mass: float
    inverse_slip_band: float
    """Inverse of the range of slip over which slip control reduces the torque to zero."""


def constants(vehicle: VehicleParameters, adhesion: float) -> Constants:
    """Compute the constants of a car on a road.

    Parameters
    ----------
    vehicle
        The car.
    adhesion
        Adhesion coefficient μ of the road, 1 on dry asphalt.

    Returns
    -------
    Constants
        Constants in SI units.
    """
    body, suspension, tyre = vehicle.body, vehicle.suspension, vehicle.tyre
    drive, steering = vehicle.drivetrain, vehicle.steering
    mass, wheelbase = body.mass_kg, body.wheelbase_m
    weight = mass * GRAVITY_MPS2
    overturning = mass * body.height_m
    friction = adhesion * tyre.friction
    drag = 0.5 * AIR_DENSITY_KGPM3 * vehicle.aerodynamics.drag_area_m2
    return Constants(
        mass=mass,
        inverse_mass=1 / mass,
        yaw_inertia=body.yaw_inertia_kgm2,
        inverse_yaw_inertia=1 / body.yaw_inertia_kgm2,
        front=body.front_axle_m,
        rear=body.rear_axle_m,
        half_track_width_front=body.track_front_m / 2,
        half_track_width_rear=body.track_rear_m / 2,
        ackermann=body.track_front_m / 2 / wheelbase,
        static_front=weight * body.rear_axle_m / wheelbase / 2,
        static_rear=weight * body.front_axle_m / wheelbase / 2,
        pitch_transfer=overturning / wheelbase / 2,
        roll_transfer_front=overturning * suspension.front_roll_share / body.track_front_m,
        roll_transfer_rear=overturning * (1 - suspension.front_roll_share) / body.track_rear_m,
        inverse_roll_lag=1 / suspension.roll_lag_s,
        inverse_pitch_lag=1 / suspension.pitch_lag_s,
        stiffness_front=tyre.peak_stiffness_n * suspension.front_stiffness_factor,
        stiffness_rear=tyre.peak_stiffness_n * suspension.rear_stiffness_factor,
        inverse_stiffness_load=1 / tyre.peak_stiffness_load_n,
        stiffness_ratio=tyre.longitudinal_stiffness_ratio,
        friction=friction * (1 + tyre.friction_load_sensitivity),
        friction_per_load=friction * tyre.friction_load_sensitivity / tyre.nominal_load_n,
        inverse_decay_speed=1 / tyre.friction_decay_speed_mps,
        rolling_resistance=tyre.rolling_resistance,
        radius=tyre.rolling_radius_m,
        inverse_radius=1 / tyre.rolling_radius_m,
        inverse_spin_inertia=1 / tyre.spin_inertia_kgm2,
        steer_per_wheel=1 / steering.ratio,
        inverse_steering_lag=1 / steering.lag_s,
        steering_limit=steering.limit_rad,
        inverse_drive_lag=1 / drive.lag_s,
        drive_front=drive.front_drive_share / 2,
        drive_rear=(1 - drive.front_drive_share) / 2,
        brake_front=drive.front_brake_share / 2,
        brake_rear=(1 - drive.front_brake_share) / 2,
        power_per_mass=drive.power_w / mass,
        drag_per_mass=drag / mass,
        inverse_slip_band=1 / (2 * drive.slip_control),
    )


class State(NamedTuple):
    """Motion of the car in its own frame, in SI units, with the signs of ISO 8855."""

    vx: float
    vy: float
    yaw_rate: float
    steering_wheel: float
    traction: float
    """Tractive force per mass behind the drivetrain's lag; braking if negative."""
    ax_lag: float
    """Longitudinal acceleration behind the lag of the load transfer."""
    ay_lag: float
    """Lateral acceleration behind the lag of the load transfer."""
    wheel_fl: float
    """Speed of the front left wheel."""
    wheel_fr: float
    wheel_rl: float
    wheel_rr: float


class Controls(NamedTuple):
    """Demands of the driver."""

    steering_wheel: float
    """Angle of the steering wheel, in rad."""
    traction: float
    """Force along the car per mass, in m/s²; braking if negative."""


Angle = Annotated[FiniteFloat, Field(ge=-5, le=5)]
RadiusError = Annotated[FiniteFloat, Field(ge=-0.1, le=0.1)]


class CarImperfections(Config):
    """Imperfections of a car; with zeros it is the textbook's car."""

    steering_lash_deg: FiniteFloat = Field(default=0.0, ge=0, le=30)
    """Free play of the steering wheel, from one end to the other."""
    steering_compliance_deg_per_kn: FiniteFloat = Field(default=0.0, ge=0, le=0.5)
    """Angle that the front wheels yield per lateral force of their axle."""
    toe_front_deg: Angle = 0.0
    """Toe angle of each front wheel, positive if the wheels point inwards."""
    toe_rear_deg: Angle = 0.0
    """Toe angle of each rear wheel, positive if the wheels point inwards."""
    thrust_angle_deg: Angle = 0.0
    """Angle of the rear axle to the left."""
    radius_error_fl: RadiusError = 0.0
    """Relative error of the rolling radius of this wheel, from pressure and wear."""
    radius_error_fr: RadiusError = 0.0
    radius_error_rl: RadiusError = 0.0
    radius_error_rr: RadiusError = 0.0
    radius_loss_mm_per_kn: FiniteFloat = Field(default=0.0, ge=0, le=5)
    """Decrease of the rolling radius per load."""
    relaxation_length_m: FiniteFloat = Field(default=0.0, ge=0, le=2)
    """Distance over which the lateral slip of a tyre builds up to 63 %."""
    cold_stiffness: FiniteFloat = Field(default=0.0, ge=-0.5, le=0.5)
    """Relative excess of the cornering stiffness at the start of a drive, on cold tyres."""
    warm_up_s: FiniteFloat = Field(default=600.0, ge=1)
    """Time constant of the decay of `cold_stiffness`."""
    roll_gradient_deg_per_g: FiniteFloat = Field(default=0.0, ge=0, le=15)
    """Roll angle of the body, and of its sensors, per lateral acceleration."""
    pitch_gradient_deg_per_g: FiniteFloat = Field(default=0.0, ge=0, le=15)
    """Pitch angle of the body, and of its sensors, per longitudinal acceleration."""
    side_force_area_m2: FiniteFloat = Field(default=0.0, ge=0)
    """Frontal area times the slope of the side force coefficient, per rad of air flow angle."""
    yawing_moment_volume_m3: FiniteFloat = Field(default=0.0, ge=0)
    """Frontal area times wheelbase times the slope of the yawing moment coefficient, per rad."""


PERFECT = CarImperfections()


class ImperfectionConstants(NamedTuple):
    """Imperfections of a car as constants of its equations, in SI units."""

    half_lash: float
    steering_compliance: float
    """Decrease of the tangent of the front wheels' angle per lateral force of the axle."""
    toe: float
    """Tangent of the toe-in of the front wheels."""
    rear_left: float
    """Tangent of the rear left wheel's angle."""
    rear_right: float
    radius_fl: float
    """Rolling radius of the front left wheel at the load at rest."""
    radius_fr: float
    radius_rl: float
    radius_rr: float
    radius_loss: float
    """Decrease of the rolling radius per load."""
    relaxes: float
    """1 if the tyres have a relaxation length, else 0."""
    inverse_relaxation: float
    cold_stiffness: float
    cooling: float
    """Factor of the excess stiffness of cold tyres after each sample."""
    wind_force: float
    """Lateral acceleration per speed and cross-wind, in 1/m."""
    wind_moment: float
    """Yaw acceleration per speed and cross-wind, in 1/m²."""


def imperfection_constants(
    vehicle: VehicleParameters, imperfections: CarImperfections, sample_s: float
) -> ImperfectionConstants:
    """Compute the constants of a car's imperfections.

    Parameters
    ----------
    vehicle
        The car.
    imperfections
        Its imperfections.
    sample_s
        Time between two samples, in s.

    Returns
    -------
    ImperfectionConstants
        Constants in SI units.
    """
    radius, body = vehicle.tyre.rolling_radius_m, vehicle.body
    toe_rear, thrust = (
        math.radians(imperfections.toe_rear_deg),
        math.radians(imperfections.thrust_angle_deg),
    )
    length_m = imperfections.relaxation_length_m
    pressure = 0.5 * AIR_DENSITY_KGPM3
    return ImperfectionConstants(
        half_lash=math.radians(imperfections.steering_lash_deg) / 2,
        steering_compliance=math.radians(imperfections.steering_compliance_deg_per_kn) / 1000,
        toe=math.radians(imperfections.toe_front_deg),
        rear_left=thrust - toe_rear,
        rear_right=thrust + toe_rear,
        radius_fl=radius * (1 + imperfections.radius_error_fl),
        radius_fr=radius * (1 + imperfections.radius_error_fr),
        radius_rl=radius * (1 + imperfections.radius_error_rl),
        radius_rr=radius * (1 + imperfections.radius_error_rr),
        radius_loss=imperfections.radius_loss_mm_per_kn * 1e-6,
        relaxes=1.0 if length_m else 0.0,
        inverse_relaxation=1 / length_m if length_m else 0.0,
        cold_stiffness=imperfections.cold_stiffness,
        cooling=1 - sample_s / imperfections.warm_up_s,
        wind_force=pressure * imperfections.side_force_area_m2 / body.mass_kg,
        wind_moment=pressure * imperfections.yawing_moment_volume_m3 / body.yaw_inertia_kgm2,
    )
