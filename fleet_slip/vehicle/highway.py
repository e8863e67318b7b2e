"""The car as a highway-env vehicle, for any of its roads and environments.

highway-env draws y downwards and counts headings from x to y. "Left" is the direction of growing y,
so that a positive steering angle turns the car to the right of the picture.
"""

import math
from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple, Self

import highway_env
import numpy as np
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.compiling import kernel
from fleet_slip.errors import RefusedError
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle import batch
from fleet_slip.vehicle.batch import CHANNELS, LaneDrive
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.dynamics import (
    CALM,
    Acceleration,
    Compliance,
    ComplianceRates,
    Environment,
    WheelForce,
    Wheels,
    body_acceleration,
    cornering_stiffness,
)
from fleet_slip.vehicle.integration import (
    FIRST_ORDER,
    SECOND_ORDER,
    STEP_S,
    Motion,
    Path,
    Pose,
    PoseSlopes,
    Slopes,
    advance_car,
)
from fleet_slip.vehicle.parameters import (
    PERFECT,
    CarImperfections,
    Constants,
    Controls,
    ImperfectionConstants,
    State,
    VehicleParameters,
    constants,
    imperfection_constants,
    load_vehicle,
)

CHECKED_S = 1.5
"""Time of a drive that is compared with highway-env."""
MIN_SCALE = 1e-3
"""Lower bound of the scale of a quantity, in SI units: a yaw rate on a straight is rounding."""
AXLES = ("MASS", "INERTIA_Z", "LENGTH_A", "LENGTH_B", "FRICTION_FRONT", "FRICTION_REAR")
BICYCLE_STATE = ("x", "y", "heading", "speed", "lateral speed", "yaw rate")


AT_REST = Motion(
    State(*len(State._fields) * (0.0,)),
    Compliance(*len(Compliance._fields) * (0.0,)),
    Pose(0.0, 0.0, 1.0, 0.0),
    Slopes(*len(Slopes._fields) * (0.0,)),
    ComplianceRates(*len(ComplianceRates._fields) * (0.0,)),
    PoseSlopes(*len(PoseSlopes._fields) * (0.0,)),
)
STRAIGHT = Path(*len(Path._fields) * (0.0,))


@kernel
def _rates_on_axles(
    x: State, along: float, front: float, rear: float, c: Constants
) -> Acceleration:
    """Return the motion of the body under a longitudinal force and lateral forces of its axles."""
    half_front = WheelForce(along / 4, front / 2, 0.0, 0.0, 0.0, 0.0)
    half_rear = WheelForce(along / 4, rear / 2, 0.0, 0.0, 0.0, 0.0)
    return body_acceleration(x, Wheels(half_front, half_front, half_rear, half_rear), c)


@kernel
def _steps(
    motion: Motion,
    u: Controls,
    path: Path,
    environment: Environment,
    c: Constants,
    t: ImperfectionConstants,
    step: float,
    count: int,
    order: float,
) -> tuple[Motion, tuple[float, float]]:
    """Advance a car on its road; also return its specific force at the start."""
    motion, ax, ay = advance_car(motion, u, path, environment, c, t, step, order)
    for _ in range(count - 1):
        motion, _, _ = advance_car(motion, u, path, environment, c, t, step, SECOND_ORDER)
    return motion, (ax, ay)


class FourWheelVehicle(BicycleVehicle):  # type: ignore[misc]
    """A car with four wheels on highway-env's roads.

    In highway-env's actions, `steering` is the angle of the road wheels in rad and `acceleration`
    the tractive force per mass in m/s². `speed` is longitudinal, as in `BicycleVehicle`; `velocity`
    has both components. A subclass for another car sets `PARAMETERS` or `ADHESION`.

    Parameters
    ----------
    road
        Road of highway-env, or None.
    position
        Position of the centre of gravity (x, y), in m.
    heading
        Heading in rad.
    speed
        Longitudinal speed in m/s.
    parameters
        The car; by default `PARAMETERS`.
    adhesion
        Adhesion coefficient of the road; by default `ADHESION`.
    imperfections
        Imperfections of the car; by default none.
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
        imperfections: CarImperfections = PERFECT,
    ) -> None:
        self.parameters = self.PARAMETERS if parameters is None else parameters
        self.adhesion = self.ADHESION if adhesion is None else adhesion
        c = self.constants = constants(self.parameters, self.adhesion)
        self.imperfections = imperfections
        self.imperfection_constants = imperfection_constants(
            self.parameters, imperfections, SAMPLE_S
        )
        self.environment, self.path = CALM, STRAIGHT
        self.MASS = c.mass
        self.INERTIA_Z = c.yaw_inertia
        self.LENGTH_A, self.LENGTH_B = c.front, c.rear
        self.FRICTION_FRONT = cornering_stiffness(c.static_front, c.stiffness_front, c)
        self.FRICTION_REAR = cornering_stiffness(c.static_rear, c.stiffness_rear, c)
        super().__init__(road, position, heading, speed)
        rolling = speed * c.inverse_radius
        state = State(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *(rolling,) * 4)
        self.last_motion = AT_REST._replace(state=state)
        self.force = (0.0, 0.0)
        self._step_s = 0.0

    @classmethod
    def create_from(cls, vehicle: Vehicle) -> Self:
        """Return a car where another vehicle is, in the same motion if it has four wheels."""
        if not isinstance(vehicle, FourWheelVehicle):
            return super().create_from(vehicle)  # type: ignore[no-any-return]
        twin = copy(vehicle)
        twin.history = deque(maxlen=cls.HISTORY_SIZE)
        return twin

    @property
    def motion(self) -> State:
        """State of the car in its own frame, with the velocities that highway-env may have set."""
        return self.last_motion.state._replace(
            vx=float(self.speed), vy=float(self.lateral_speed), yaw_rate=float(self.yaw_rate)
        )

    @property
    def sideslip(self) -> float:
        """Side-slip angle in rad."""
        return math.atan2(self.lateral_speed, self.speed)

    @property
    def controls(self) -> Controls:
        """Demands of the present action on steering wheel and drivetrain."""
        steering = self.parameters.steering
        angle = steering.ratio * math.tan(float(self.action["steering"]))
        angle = min(max(angle, -steering.limit_rad), steering.limit_rad)
        return Controls(angle, float(self.action["acceleration"]))

    @property
    def velocity(self) -> FloatArray:
        """Velocity of the centre of gravity in highway-env's plane, shape (2,), in m/s."""
        return np.array(_plane_velocity(self.heading, self.speed, self.lateral_speed))

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds in steps of at most `STEP_S`; in the plane by mean velocities."""
        self.clip_actions()
        count = max(1, math.ceil(dt / STEP_S - 1e-9))
        step_s, before = dt / count, self.motion
        order = SECOND_ORDER if step_s == self._step_s else FIRST_ORDER
        self.last_motion, self.force = _steps(
            self.last_motion._replace(state=before),
            self.controls,
            self.path,
            self.environment,
            self.constants,
            self.imperfection_constants,
            step_s,
            count,
            order,
        )
        self._step_s = step_s
        self.speed, self.lateral_speed, self.yaw_rate = after = self.last_motion.state[:3]
        vx, vy, yaw_rate = np.add(before[:3], after) / 2
        velocity = _plane_velocity(self.heading + dt * yaw_rate / 2, vx, vy)
        self.position = self.position + dt * np.array(velocity)
        self.heading = float(self.heading + dt * yaw_rate)
        self.on_state_update()


def _plane_velocity(heading: float, vx: float, vy: float) -> tuple[float, float]:
    cosine, sine = math.cos(heading), math.sin(heading)
    return vx * cosine - vy * sine, vx * sine + vy * cosine


class LinearTyreVehicle(FourWheelVehicle):
    """`FourWheelVehicle` without extensions: it moves as highway-env's own bicycle.

    Its axles have linear tyres, it has no lags and no drag, and its speed follows the demand.

    References
    ----------
    R. Rajamani, "Vehicle Dynamics and Control" (2012), equations 2.21 to 2.28.
    """

    step = BicycleVehicle.step

    def derivative_func(self, time: float, state: FloatArray, **_: Any) -> Any:
        """Return the rates of the state (x, y, heading, vx, vy, yaw rate), shape (6, 1)."""
        del time
        heading, vx, vy, yaw_rate = (float(value) for value in state[2:, 0])
        x = self.last_motion.state._replace(vx=vx, vy=vy, yaw_rate=yaw_rate)
        c = self.constants._replace(drag_per_mass=0.0)
        slip_front = self.action["steering"] - math.atan2(vy + c.front * yaw_rate, vx)
        slip_rear = -math.atan2(vy - c.rear * yaw_rate, vx)
        along = c.mass * (self.action["acceleration"] - yaw_rate * vy)
        front, rear = 2 * self.FRICTION_FRONT * slip_front, 2 * self.FRICTION_REAR * slip_rear
        rates = _rates_on_axles(x, along, front, rear, c)
        pose_rates = (*_plane_velocity(heading, vx, vy), yaw_rate)
        return np.array([*pose_rates, rates.vx, rates.vy, rates.yaw_rate])[:, np.newaxis]


class HighwayLanes:
    """Advances lanes as `batch.simulate_lanes`, each car by `FourWheelVehicle.step`.

    Roads, drivers and records are those of the kernel.
    """

    def __init__(self, drives: Sequence[LaneDrive]) -> None:
        self._drives = drives
        self._vehicles: dict[int, FourWheelVehicle] = {}

    def __call__(
        self,
        routes: NDArray[np.void],
        roads: FloatArray,
        surfaces: FloatArray,
        steps: int,
        memory: FloatArray,
        lane_table: IntArray,
        truth: FloatArray,
        results: IntArray,
    ) -> None:
        """Simulate sample by sample until a drive ends."""
        del steps
        lanes = memory.reshape(batch.ROWS, batch.LANES).T
        ended = 0
        while ended == 0:
            batch.begin_sample(routes, roads, surfaces, memory, lane_table, truth, results)
            for lane, drive in enumerate(lane_table[batch.DRIVE].tolist()):
                if drive != batch.ABSENT:
                    self._step(drive, lanes[lane])
            ended = batch.finish_sample(routes, memory, lane_table, truth, results)

    def _step(self, drive: int, column: FloatArray) -> None:
        """Advance the vehicle of a drive by a sample; `column` is the lane's memory."""
        vehicle = self._vehicles.get(drive)
        if vehicle is None:
            vehicle = self._vehicles[drive] = vehicle_of(self._drives[drive], float(column[0]))
        demands = Controls(*_read(column, batch.CONTROLS, Controls))
        vehicle.environment = Environment(*_read(column, batch.ENVIRONMENT, Environment))
        vehicle.path = Path(*_read(column, batch.PATH, Path))
        pose = Pose(*_read(column, batch.POSE, Pose))  # in this lap
        vehicle.last_motion = vehicle.last_motion._replace(pose=pose)
        wheel = math.atan(demands.steering_wheel / vehicle.parameters.steering.ratio)
        vehicle.act({"steering": wheel, "acceleration": demands.traction})
        vehicle.step(SAMPLE_S)
        motion = vehicle.last_motion
        for row, values in (
            (batch.STATE, motion.state),
            (batch.SLOPES, motion.slopes),
            (batch.POSE, motion.pose),
            (batch.FORCE, vehicle.force),
            (batch.COMPLIANCE, motion.compliance),
        ):
            column[row : row + len(values)] = values


def _read(column: FloatArray, row: int, fields: type[NamedTuple]) -> list[float]:
    return column[row : row + len(fields._fields)].tolist()  # type: ignore[no-any-return]


def vehicle_of(
    drive: LaneDrive, speed_mps: float, kind: type[FourWheelVehicle] = FourWheelVehicle
) -> FourWheelVehicle:
    """Return the car of a drive as a vehicle of highway-env, without a limit of its speed."""
    vehicle = kind(None, [0.0, 0.0], 0.0, speed_mps, drive.vehicle, drive.adhesion, drive.flaws)
    vehicle.MAX_SPEED, vehicle.MIN_SPEED = math.inf, -math.inf
    return vehicle


def highway_twin(car: FourWheelVehicle) -> BicycleVehicle:
    """Return highway-env's own vehicle with the mass, inertia, axles and motion of a car."""
    twin = BicycleVehicle(None, car.position, car.heading, car.speed)
    for name in (*AXLES, "MAX_SPEED"):
        setattr(twin, name, getattr(car, name))
    return twin


def require_agreement(drive: LaneDrive, name: str, tolerance: float) -> None:
    """Require that the first 1.5 s of a drive agree with highway-env.

    The kernel is compared with `HighwayLanes`, and `LinearTyreVehicle` with highway-env's
    `BicycleVehicle`, under the steering and acceleration of the kernel's car.

    Parameters
    ----------
    drive
        A drive of a car without imperfections.
    name
        Name of the drive, for messages.
    tolerance
        Largest difference over the largest value of a quantity.

    Raises
    ------
    RefusedError
        If a quantity differs by more than the tolerance.
    """
    speed = float(drive.road.speed_mps[0])
    short = replace(drive, laps=CHECKED_S * speed / drive.road.length_m)
    by_kernel, by_vehicle = (
        next(batch.simulate_drives([short], simulate_lanes=lanes)).channels
        for lanes in (batch.simulate_lanes, HighwayLanes([short]))
    )
    linear = vehicle_of(drive, speed, LinearTyreVehicle)
    bicycle = highway_twin(linear)
    linear_states: list[FloatArray] = []
    bicycle_states: list[FloatArray] = []
    for angle, force in zip(by_kernel["steering_wheel_rad"], by_kernel["ax_mps2"], strict=True):
        wheel = math.atan(angle / drive.vehicle.steering.ratio)
        for vehicle, states in ((linear, linear_states), (bicycle, bicycle_states)):
            vehicle.act({"steering": wheel, "acceleration": force})
            vehicle.step(SAMPLE_S)
            states.append(vehicle.state[:, 0])
    length = min(len(channels["vx_mps"]) for channels in (by_kernel, by_vehicle))
    kernel_states, car_states = (
        np.stack([channels[name][:length] for name in CHANNELS], axis=1)
        for channels in (by_kernel, by_vehicle)
    )
    for quantities, values, expected, kind in (
        (CHANNELS, kernel_states, car_states, FourWheelVehicle),
        (BICYCLE_STATE, linear_states, bicycle_states, BicycleVehicle),
    ):
        difference = np.abs(np.subtract(values, expected))
        largest = np.abs(expected).max(axis=0)
        wrong = np.argwhere(~(difference <= tolerance * np.maximum(largest, MIN_SCALE)))
        if not len(wrong):
            continue
        tick, quantity = wrong[0]
        raise RefusedError(
            f"the simulated car departs from highway-env: {tick * SAMPLE_S:.2f} s after the "
            f"start of {name}, {quantities[quantity]} is {values[tick][quantity]:.9g}, but "
            f"{expected[tick][quantity]:.9g} in {kind.__name__}. The file was not written. The "
            f"compiler or highway-env {highway_env.__version__} differs from the tested one: "
            "install the versions of constraints.txt and run the command again."
        )
