"""The car as a highway-env vehicle, for any of its roads and environments.

y is drawn downwards and headings count from x to y: "left" is the direction of growing y, and a
positive steering angle turns to the right of the picture.
"""

import math
from typing import Any, NamedTuple, Self

import highway_env
import numpy as np
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.errors import RefusedError
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.batch import LaneDrive, simulate_samples
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.dynamics import (
    NO_BRAKES,
    Acceleration,
    Derivative,
    WheelForce,
    WheelForces,
    derivative,
    driven_body,
)
from fleet_slip.vehicle.integration import (
    FIRST_ORDER,
    SECOND_ORDER,
    STEP_S,
    Slopes,
    advance,
    extrapolate,
)
from fleet_slip.vehicle.parameters import (
    Constants,
    Controls,
    State,
    VehicleParameters,
    constants,
    load_vehicle,
)
from fleet_slip.vehicle.tyre import cornering_stiffness

NO_SLOPES = Slopes(*(0.0 for _ in Slopes._fields))


CHECKED_SAMPLES = 150
"""So much of a drive is compared with highway-env: 1.5 s."""
LEAST_SCALE = 1e-3
"""Of a quantity that stays near zero, in SI units: a yaw rate on a straight is rounding."""
AXLES = ("MASS", "INERTIA_Z", "LENGTH_A", "LENGTH_B", "FRICTION_FRONT", "FRICTION_REAR")
BICYCLE_STATE = ("x", "y", "heading", "speed", "lateral speed", "yaw rate")


class Place(NamedTuple):
    """Where the car stands in highway-env's plane, or how fast that changes."""

    x: float
    y: float
    heading: float


class Motion(NamedTuple):
    """All that moves: the car, its place, and what the next step needs of the last one."""

    state: State
    place: Place
    slopes: Slopes
    drift: Place


@kernel
def _rates(x: State, u: Controls, c: Constants) -> Derivative:
    return derivative(x, u, NO_BRAKES, c)


@kernel
def _rates_on_axles(
    x: State, along: float, front: float, rear: float, c: Constants
) -> Acceleration:
    """Return how the body moves under a force along it and lateral forces of its axles."""
    half_front = WheelForce(along / 4, front / 2, 0.0, 0.0, 0.0, 0.0)
    half_rear = WheelForce(along / 4, rear / 2, 0.0, 0.0, 0.0, 0.0)
    return driven_body(x, WheelForces(half_front, half_front, half_rear, half_rear), c)


@equation
def _drift_of(x: State, place: Place) -> Place:
    cosine, sine = math.cos(place.heading), math.sin(place.heading)
    return Place(x.vx * cosine - x.vy * sine, x.vx * sine + x.vy * cosine, x.yaw_rate)


@kernel
def _steps(
    motion: Motion, u: Controls, c: Constants, step: float, count: int, order: float
) -> Motion:
    x, place, slopes, before = motion
    for _ in range(count):
        drift = _drift_of(x, place)
        place = Place(
            place.x + step * extrapolate(drift.x, before.x, order),
            place.y + step * extrapolate(drift.y, before.y, order),
            place.heading + step * extrapolate(drift.heading, before.heading, order),
        )
        before = drift
        x, slopes = advance(x, derivative(x, u, NO_BRAKES, c), slopes, c, step, order)
        order = SECOND_ORDER
    return Motion(x, place, slopes, before)


class FourWheelVehicle(BicycleVehicle):  # type: ignore[misc]
    """A car with four wheels on highway-env's roads.

    Of highway-env's actions `steering` is the road wheels' angle in rad, `acceleration` the
    tractive force per mass in m/s². `speed` is longitudinal, as in `BicycleVehicle`; `velocity` has
    both parts. A class for another car sets `PARAMETERS` or `ADHESION`.
    """

    PARAMETERS: VehicleParameters = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
    ADHESION: float = 1.0
    MAX_SPEED: float = 70.0
    MIN_SPEED: float = -70.0

    position: FloatArray
    heading: float
    speed: float
    lateral_speed: float
    yaw_rate: float

    def __init__(
        self,
        road: Any,
        position: Any,
        heading: float = 0,
        speed: float = 0,
        parameters: VehicleParameters | None = None,
        adhesion: float | None = None,
    ) -> None:
        """Put the car on a road, or none, straight ahead, in m, rad and m/s."""
        self.parameters = self.PARAMETERS if parameters is None else parameters
        self.adhesion = self.ADHESION if adhesion is None else adhesion
        c = self.constants = constants(self.parameters, self.adhesion)
        self.MASS = c.mass
        self.INERTIA_Z = c.yaw_inertia
        self.LENGTH_A, self.LENGTH_B = c.front, c.rear
        self.FRICTION_FRONT = cornering_stiffness(c.static_front, c.stiffness_front, c)
        self.FRICTION_REAR = cornering_stiffness(c.static_rear, c.stiffness_rear, c)
        super().__init__(road, position, heading, speed)
        rolling = speed * c.inverse_radius
        self._hidden = State(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *(rolling,) * 4)
        self._slopes = NO_SLOPES
        self._drift = Place(0.0, 0.0, 0.0)
        self._step_s = 0.0

    @classmethod
    def create_from(cls, vehicle: Vehicle) -> Self:
        """Return a car where another vehicle is, in the same motion if that is of this kind."""
        if not isinstance(vehicle, FourWheelVehicle):
            return super().create_from(vehicle)  # type: ignore[no-any-return]
        copy = cls(
            vehicle.road,
            vehicle.position,
            vehicle.heading,
            vehicle.speed,
            vehicle.parameters,
            vehicle.adhesion,
        )
        copy.lateral_speed, copy.yaw_rate = vehicle.lateral_speed, vehicle.yaw_rate
        copy._hidden = vehicle._hidden
        if hasattr(vehicle, "color"):
            copy.color = vehicle.color
        return copy

    @property
    def motion(self) -> State:
        """State of the car in its own frame; velocities as highway-env may have set them."""
        return self._hidden._replace(
            vx=float(self.speed), vy=float(self.lateral_speed), yaw_rate=float(self.yaw_rate)
        )

    @property
    def sideslip(self) -> float:
        """Side-slip angle in rad."""
        return math.atan2(self.lateral_speed, self.speed)

    @property
    def controls(self) -> Controls:
        """The present action as demands on steering wheel and drivetrain."""
        steering = self.parameters.steering
        angle = steering.ratio * math.tan(float(self.action["steering"]))
        angle = min(max(angle, -steering.limit_rad), steering.limit_rad)
        return Controls(angle, float(self.action["acceleration"]))

    @property
    def velocity(self) -> FloatArray:
        """Velocity of the centre of gravity in highway-env's plane, with its lateral part."""
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        vx, vy = self.speed, self.lateral_speed
        return np.array([vx * cosine - vy * sine, vx * sine + vy * cosine])

    def derivative_func(self, time: float, state: FloatArray, **_: Any) -> Any:
        """Return the rates of highway-env's state (x, y, heading, vx, vy, yaw rate), (6, 1)."""
        del time
        heading, vx, vy, yaw_rate = (float(value) for value in state[2:, 0])
        rates = self._rates_of(self._hidden._replace(vx=vx, vy=vy, yaw_rate=yaw_rate))
        cosine, sine = math.cos(heading), math.sin(heading)
        place = (vx * cosine - vy * sine, vx * sine + vy * cosine, yaw_rate)
        return np.array([*place, rates.vx, rates.vy, rates.yaw_rate])[:, np.newaxis]

    def _rates_of(self, x: State) -> Derivative | Acceleration:
        return _rates(x, self.controls, self.constants)

    def step(self, dt: float) -> None:
        """Move on by `dt` s in steps of at most `STEP_S`."""
        self.clip_actions()
        count = max(1, math.ceil(dt / STEP_S - 1e-9))
        step_s = dt / count
        order = SECOND_ORDER if step_s == self._step_s else FIRST_ORDER
        place = Place(float(self.position[0]), float(self.position[1]), float(self.heading))
        moved = _steps(
            Motion(self.motion, place, self._slopes, self._drift),
            self.controls,
            self.constants,
            step_s,
            count,
            order,
        )
        self._hidden, self._slopes, self._drift = moved.state, moved.slopes, moved.drift
        self._step_s = step_s
        self.position = np.array([moved.place.x, moved.place.y])
        self.heading = moved.place.heading
        self.speed, self.lateral_speed, self.yaw_rate = moved.state[:3]
        self.on_state_update()


class PlainVehicle(FourWheelVehicle):
    """`FourWheelVehicle` with all extensions off, which moves as highway-env's own bicycle.

    Its axles have linear tyres, nothing lags or drags, and its speed follows the demand. Rajamani,
    equations 2.21 to 2.28.
    """

    step = BicycleVehicle.step

    def _rates_of(self, x: State) -> Acceleration:
        """Return how the body moves under the forces of linear axles."""
        c = self.constants._replace(drag_per_mass=0.0)
        slip_front = self.action["steering"] - math.atan2(x.vy + c.front * x.yaw_rate, x.vx)
        slip_rear = -math.atan2(x.vy - c.rear * x.yaw_rate, x.vx)
        along = c.mass * (self.action["acceleration"] - x.yaw_rate * x.vy)
        front, rear = 2 * self.FRICTION_FRONT * slip_front, 2 * self.FRICTION_REAR * slip_rear
        return _rates_on_axles(x, along, front, rear, c)


def bicycle_of(car: FourWheelVehicle) -> BicycleVehicle:
    """Return highway-env's own vehicle with a car's mass, inertia, axles and motion."""
    twin = BicycleVehicle(None, car.position, car.heading, car.speed)
    for name in (*AXLES, "MAX_SPEED"):
        setattr(twin, name, getattr(car, name))
    return twin


def require_agreement(drive: LaneDrive, name: str, tolerance: float) -> None:
    """Raise `RefusedError` if the first seconds of a drive are not as highway-env drives them.

    The kernel's car is compared with `FourWheelVehicle`, and that without its extensions with
    `BicycleVehicle`, under the demands of the kernel's driver. The drive is of a perfect car.
    What departs by more than `tolerance` of a quantity's largest value is refused.
    """
    speed = float(drive.road.speed_mps[0])
    car, plain = (
        kind(None, [0.0, 0.0], speed=speed, parameters=drive.vehicle, adhesion=drive.adhesion)
        for kind in (FourWheelVehicle, PlainVehicle)
    )
    car.MAX_SPEED = plain.MAX_SPEED = math.inf
    bicycle = bicycle_of(plain)
    kernel, extended, ours, theirs = [], [], [], []
    for demands, moved in simulate_samples(drive, CHECKED_SAMPLES):
        wheel = math.atan(demands.steering_wheel / drive.vehicle.steering.ratio)
        for vehicle in (car, plain, bicycle):
            vehicle.act({"steering": wheel, "acceleration": demands.traction})
            vehicle.step(SAMPLE_S)
        kernel.append(moved)
        extended.append(car.motion)
        ours.append(plain.state[:, 0])
        theirs.append(bicycle.state[:, 0])
    for quantities, one, other, vehicle in (
        (State._fields, kernel, extended, FourWheelVehicle),
        (BICYCLE_STATE, ours, theirs, BicycleVehicle),
    ):
        apart, largest = np.abs(np.subtract(one, other)), np.abs(other).max(axis=0)
        wrong = np.argwhere(~(apart <= tolerance * np.maximum(largest, LEAST_SCALE)))
        if not len(wrong):
            continue
        tick, quantity = wrong[0]
        raise RefusedError(
            f"the simulated car departs from highway-env: {(tick + 1) * SAMPLE_S:.2f} s after the "
            f"start of {name}, {quantities[quantity]} is {one[tick][quantity]:.9g}, but "
            f"{other[tick][quantity]:.9g} of {vehicle.__name__}. Its file is not written. The "
            f"compiler or highway-env {highway_env.__version__} is not as expected: install the "
            "versions that constraints.txt names, and give the command again."
        )
