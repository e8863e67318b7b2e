"""The filter in an identified car as a column: an integer observer, and its blend with a line."""

from collections.abc import Collection, Sequence

from fleet_slip.catalog.definitions import (
    Definition,
    Observer,
    ObserverCar,
    ObserverInput,
)
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.evaluation.evaluator import MissingSignalError
from fleet_slip.evaluation.identify import IdentifiedVehicle

WHEELS = {"rear": ("wheel_rl", "wheel_rr"), "front": ("wheel_fl", "wheel_fr")}


def observer_of(
    vehicle: IdentifiedVehicle, signals: SignalCatalog, logged: Collection[str], *, one_speed: bool
) -> Observer:
    """Return the observer of a car for the logged signals.

    `one_speed`: a single speed replaces those of all wheels. Raises `MissingSignalError`.
    """
    car, sensors = vehicle.car, vehicle.noise.sensors
    is_rear = one_speed or car.drivetrain.front_drive_share >= 0.5
    wheels = WHEELS["rear" if is_rear else "front"]
    steered = [name for name in ("steer_fl", "steer_fr") if name in logged]
    ratio = 1.0
    if not steered:
        steered, ratio = ["steering_wheel"], car.steering.ratio
    if missing := [n for n in ("ay", "yaw_rate", *wheels, *steered) if n not in logged]:
        raise MissingSignalError(
            f"the drives have no {', '.join(missing)}, which the filter needs."
        )

    def entry(
        names: Sequence[str], factor: float = 1.0, *, adds: bool = True, offset: float = 0.0
    ) -> ObserverInput:
        scale = float(signals[names[0]].scale) * factor / (len(names) if adds else 1)
        columns = tuple(Definition(of=name) for name in names)
        return ObserverInput(of=columns, scale=scale, adds=adds, offset=offset)

    radius = car.tyre.rolling_radius_m
    return Observer(
        ay=entry(["ay"], 1 / sensors.ay_gain, offset=sensors.ay_offset_mps2 / sensors.ay_gain),
        yaw_rate=entry(["yaw_rate"]),
        speed=entry(wheels[:1] if one_speed else wheels, radius),
        steer=entry(
            steered,
            1 / ratio / sensors.steer_gain,
            offset=sensors.steer_offset_rad / sensors.steer_gain,
        ),
        ax=entry(["ax"]) if "ax" in logged else None,
        wheels=None if one_speed else entry(wheels[::-1], radius, adds=False),
        axle="rear" if is_rear else "front",
        car=car_of(vehicle),
    )


def car_of(vehicle: IdentifiedVehicle) -> ObserverCar:
    """Return the numbers of an identified car and its filter."""
    car, noise = vehicle.car, vehicle.noise
    body, suspension, tyre, yaw = car.body, car.suspension, car.tyre, noise.yaw_rate
    return ObserverCar(
        mass_kg=body.mass_kg,
        yaw_inertia_kgm2=body.yaw_inertia_kgm2,
        front_axle_m=body.front_axle_m,
        rear_axle_m=body.rear_axle_m,
        height_m=body.height_m,
        track_front_m=body.track_front_m,
        track_rear_m=body.track_rear_m,
        front_roll_share=suspension.front_roll_share,
        roll_lag_s=suspension.roll_lag_s,
        pitch_lag_s=suspension.pitch_lag_s,
        stiffness_front_n=tyre.peak_stiffness_n
        * suspension.front_stiffness_factor
        * noise.stiffness_front_factor,
        stiffness_rear_n=tyre.peak_stiffness_n
        * suspension.rear_stiffness_factor
        * noise.stiffness_rear_factor,
        stiffness_load_n=tyre.peak_stiffness_load_n,
        friction=tyre.friction * noise.adhesion,
        friction_load_sensitivity=tyre.friction_load_sensitivity,
        nominal_load_n=tyre.nominal_load_n,
        **{name: getattr(noise, name) for name in ObserverCar.model_fields if hasattr(noise, name)},
        **{name: getattr(yaw, name) for name in ObserverCar.model_fields if hasattr(yaw, name)},
    )
