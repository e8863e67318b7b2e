"""Simulates many drives at once: each is a lane of a loop that the compiler vectorises.

At every sample a scalar part reads the road and records the truth. Driver and physics are loops
over all lanes, which compile to vector instructions. The compiled loop returns when a drive ends,
and its lane takes the next one.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.errors import ConfigError
from fleet_slip.vehicle.driver import (
    SAMPLE_S,
    SPEED_PREVIEW_S,
    STEERING_PREVIEW_S,
    Handling,
    decide,
    handling,
)
from fleet_slip.vehicle.dynamics import (
    CALM,
    Compliance,
    ComplianceRates,
    Environment,
    arctan2,
    front_wheels,
)
from fleet_slip.vehicle.integration import (
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
)

# Lanes in memory. Every quantity is a row of `LANES` numbers in one flat array, at an offset that
# is constant at compile time, so that loops over lanes become vector instructions.

LANES = 8
"""Lanes of the kernel: one or two vectors of a processor."""


def _address(context: Any, builder: Any, array_type: Any, args: Any, index: int) -> Any:
    """Emit the address of a lane in the `index`-th row after a first row."""
    memory, first_row, lane = args[:3]
    integer = first_row.type
    row = builder.add(first_row, ir.Constant(integer, index))
    offset = builder.add(builder.mul(row, ir.Constant(integer, LANES)), lane)
    data = context.make_array(array_type)(context, builder, memory).data
    return builder.gep(data, [offset], inbounds=True)


@intrinsic
def _read(_typing_context: Any, memory: Any, _first_row: Any, _lane: Any, kind: Any) -> Any:
    fields = kind.instance_class
    count = len(fields._fields)
    result = types.NamedUniTuple(types.float64, count, fields)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array_type = signature.args[0]
        values = [
            builder.load(_address(context, builder, array_type, args, index))
            for index in range(count)
        ]
        return context.make_tuple(builder, result, values)

    return result(memory, types.intp, types.intp, kind), codegen


@intrinsic
def _write(_typing_context: Any, memory: Any, _first_row: Any, _lane: Any, values: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array_type = signature.args[0]
        for index in range(signature.args[3].count):
            value = builder.extract_value(args[3], index)
            builder.store(value, _address(context, builder, array_type, args, index))
        return context.get_dummy_value()

    return types.void(memory, types.intp, types.intp, values), codegen


read: Callable[..., Any] = _read
"""Read one lane of successive rows as a named tuple: `read(memory, ROW, lane, State)`."""

write: Callable[..., None] = _write
"""Write a tuple of floats to one lane of successive rows: `write(memory, ROW, lane, values)`."""


ROUTE = np.dtype(
    [
        ("first", np.int64),  # index of the road's first entry in the table of all roads
        ("last", np.int64),  # index of its last entry
        ("inverse_spacing", np.float64),
        ("length_m", np.float64),
        ("closed", np.bool_),
        ("distance_m", np.float64),
        ("samples", np.int64),  # limit of the number of samples
    ]
)


@equation
def locate(route: Any, station: float) -> tuple[int, float]:
    """Return the entry at or before a station, and the fraction of the interval behind it."""
    entries = station * route.inverse_spacing
    entry = min(max(math.floor(entries), 0), route.last - route.first - 1)
    return route.first + entry, min(max(entries - entry, 0.0), 1.0)


ABSENT = -1
"""Drive of a vacant lane, and tick of a loss that has not happened."""

DRIVE, TICK, LAP = range(3)
"""Rows of the lane table: drive, tick of the next sample, and lap."""

_STATES = (State, Slopes, Pose, PoseSlopes, Controls, Path)
_PARAMETERS = (Constants, Handling, ImperfectionConstants, Environment, Compliance, ComplianceRates)
STATE, SLOPES, POSE, POSE_SLOPES, CONTROLS, PATH, FORCE = accumulate(
    (len(fields._fields) for fields in _STATES), initial=0
)
"""First rows of tuples in memory. `FORCE` are specific force ax, ay at the sample."""
ANGLES, ORDER = FORCE + 2, FORCE + 5
"""Angles of the front wheels, and side-slip angle, at the sample. Order of the integration:
`FIRST_ORDER` in a drive's first step."""
CAR, HANDLING, IMPERFECTION_CONSTANTS, ENVIRONMENT, COMPLIANCE, COMPLIANCE_RATES, ROWS = accumulate(
    (len(fields._fields) for fields in _PARAMETERS), initial=ORDER + 1
)

INVERSE_RADIUS = Constants._fields.index("inverse_radius")


def empty_lanes() -> tuple[FloatArray, IntArray]:
    """Return the memory and the lane table of vacant lanes: cars at rest."""
    return np.zeros(ROWS * LANES), np.full((3, LANES), ABSENT)


def start_drive(
    memory: FloatArray,
    lane_table: IntArray,
    lane: int,
    drive: int,
    car: FloatArray,
    speed_mps: float,
) -> None:
    """Start a drive on a lane: the car rolls straight along the line, on cold tyres."""
    lane_table[:, lane] = drive, 0, 0
    spin = speed_mps * car[INVERSE_RADIUS]
    column = memory.reshape(ROWS, LANES)[:, lane]
    column[:] = 0.0
    column[CAR : CAR + len(car)] = car
    column[STATE : STATE + len(State._fields)] = State(speed_mps, *6 * (0.0,), *4 * (spin,))
    column[POSE : POSE + len(Pose._fields)] = Pose(0.0, 0.0, 1.0, 0.0)
    cold = column[IMPERFECTION_CONSTANTS + ImperfectionConstants._fields.index("cold_stiffness")]
    environment = CALM._replace(stiffness=1.0 + cold)
    column[ENVIRONMENT : ENVIRONMENT + len(environment)] = environment


def vacate(memory: FloatArray, lane_table: IntArray, lane: int) -> None:
    """Remove the drive of a lane; a car at rest remains."""
    lane_table[DRIVE, lane] = ABSENT
    memory.reshape(ROWS, LANES)[:, lane] = 0.0


STATE_CHANNELS = {
    "yaw_rate_rad_s": STATE + State._fields.index("yaw_rate"),
    "steering_wheel_rad": STATE + State._fields.index("steering_wheel"),
    "wheel_fl_rad_s": STATE + State._fields.index("wheel_fl"),
    "wheel_fr_rad_s": STATE + State._fields.index("wheel_fr"),
    "wheel_rl_rad_s": STATE + State._fields.index("wheel_rl"),
    "wheel_rr_rad_s": STATE + State._fields.index("wheel_rr"),
    "vx_mps": STATE + State._fields.index("vx"),
    "vy_mps": STATE + State._fields.index("vy"),
    "station_m": POSE,
    "lateral_offset_m": POSE + 1,
    "yaw_acceleration_rad_s2": SLOPES + Slopes._fields.index("yaw_rate"),
    "leaning_ax_mps2": STATE + State._fields.index("ax_lag"),
    "leaning_ay_mps2": STATE + State._fields.index("ay_lag"),
}
"""Channels recorded before the first step of a sample, with their rows in memory. Sensors need the
last three: the yaw acceleration, and the accelerations behind the lags of pitch and roll."""

STEP_CHANNELS = {
    "ax_mps2": FORCE,
    "ay_mps2": FORCE + 1,
    "steer_fl_rad": ANGLES,
    "steer_fr_rad": ANGLES + 1,
    "sideslip_rad": ANGLES + 2,
}
"""Channels recorded after the steps of a sample, with their rows in memory."""

CHANNELS = (*STATE_CHANNELS, *STEP_CHANNELS)
STATE_ROWS = tuple(STATE_CHANNELS.values())
STEP_ROWS = tuple(STEP_CHANNELS.values())

SAMPLES_AFTER_LOSS = 500
"""Samples of a drive after the driver lost the car: 5 s."""
LOST_OFFSET_M = 10.0
LOST_SLIP_TANGENT = math.sqrt(3.0)
"""Tangent of a side-slip angle of 60°."""
LOST_SPEED_MPS = 0.5

CURVATURE, SPEED, ACCELERATION = range(3)
"""Columns of the table of all roads: curvature, target speed, target acceleration."""

SAMPLES, LOST = range(2)
"""Columns of the results: number of samples of a drive, and the tick of its loss or `ABSENT`."""


@equation
def _preview(
    roads: Any, route: Any, x: State, station: float, entry: int, fraction: float, lost: bool
) -> Path:
    """Return the road as the driver sees it from a station, `fraction` of an interval on."""
    curvature = roads[entry, CURVATURE]
    change = roads[entry + 1, CURVATURE] - curvature
    i, p = locate(route, station + STEERING_PREVIEW_S * x.vx)
    j, q = locate(route, station + SPEED_PREVIEW_S * x.vx)
    return Path(
        station,
        curvature + fraction * change,
        change * route.inverse_spacing,
        (1.0 - p) * roads[i, CURVATURE] + p * roads[i + 1, CURVATURE],
        (1.0 - q) * roads[j, SPEED] + q * roads[j + 1, SPEED],
        (1.0 - q) * roads[j, ACCELERATION] + q * roads[j + 1, ACCELERATION],
        1.0 if lost else 0.0,
    )


@equation
def _update_environment(memory: Any, lane: int, surfaces: Any, entry: int, fraction: float) -> None:
    """Read road and air at the car, and warm its tyres."""
    for column in range(5):
        before, after = surfaces[entry, column], surfaces[entry + 1, column]
        memory[(ENVIRONMENT + column) * LANES + lane] = before + fraction * (after - before)
    cooling = read(memory, IMPERFECTION_CONSTANTS, lane, ImperfectionConstants).cooling
    stiffness = (ENVIRONMENT + 5) * LANES + lane
    memory[stiffness] = 1.0 + (memory[stiffness] - 1.0) * cooling


@equation
def _has_lost(x: State, pose: Pose) -> bool:
    """Return True if the car has left the road, spun or stopped."""
    return (
        abs(pose.offset) > LOST_OFFSET_M
        or abs(x.vy) > LOST_SLIP_TANGENT * x.vx
        or x.vx < LOST_SPEED_MPS
    )


@equation
def decide_lanes(memory: Any) -> None:
    """Compute the demands of all drivers, and the angles at the sample."""
    for lane in range(LANES):
        x = read(memory, STATE, lane, State)
        pose = read(memory, POSE, lane, Pose)
        path = read(memory, PATH, lane, Path)
        previous = read(memory, CONTROLS, lane, Controls)
        h = read(memory, HANDLING, lane, Handling)
        c = read(memory, CAR, lane, Constants)
        t = read(memory, IMPERFECTION_CONSTANTS, lane, ImperfectionConstants)
        compliance = read(memory, COMPLIANCE, lane, Compliance)
        (along_l, across_l), (along_r, across_r) = front_wheels(compliance, c, t)
        angles = arctan2(across_l, along_l), arctan2(across_r, along_r), arctan2(x.vy, x.vx)
        write(memory, ANGLES, lane, angles)
        write(memory, CONTROLS, lane, decide(x, pose, path, previous, h, c))


@equation
def integrate_lanes(memory: Any, step_s: float, first_step: bool) -> None:
    """Advance all cars by one step; keep the specific force of a sample's first step."""
    for lane in range(LANES):
        motion = Motion(
            read(memory, STATE, lane, State),
            read(memory, COMPLIANCE, lane, Compliance),
            read(memory, POSE, lane, Pose),
            read(memory, SLOPES, lane, Slopes),
            read(memory, COMPLIANCE_RATES, lane, ComplianceRates),
            read(memory, POSE_SLOPES, lane, PoseSlopes),
        )
        u = read(memory, CONTROLS, lane, Controls)
        path = read(memory, PATH, lane, Path)
        environment = read(memory, ENVIRONMENT, lane, Environment)
        c = read(memory, CAR, lane, Constants)
        t = read(memory, IMPERFECTION_CONSTANTS, lane, ImperfectionConstants)
        order = memory[ORDER * LANES + lane]
        after, ax, ay = advance_car(motion, u, path, environment, c, t, step_s, order)
        if not first_step:
            ax, ay = memory[FORCE * LANES + lane], memory[(FORCE + 1) * LANES + lane]
        write(memory, STATE, lane, after.state)
        write(memory, COMPLIANCE, lane, after.compliance)
        write(memory, POSE, lane, after.pose)
        write(memory, SLOPES, lane, after.slopes)
        write(memory, COMPLIANCE_RATES, lane, after.compliance_rates)
        write(memory, POSE_SLOPES, lane, after.pose_slopes)
        write(memory, FORCE, lane, (ax, ay))
        memory[ORDER * LANES + lane] = SECOND_ORDER


@kernel
def begin_sample(
    routes: Any, roads: Any, surfaces: Any, memory: Any, lane_table: Any, truth: Any, results: Any
) -> None:
    """Record the states of all cars and read their roads; compute the demands of their drivers."""
    for lane in range(LANES):
        drive, tick = lane_table[DRIVE, lane], lane_table[TICK, lane]
        if drive != ABSENT:
            x = read(memory, STATE, lane, State)
            pose = read(memory, POSE, lane, Pose)
            if results[drive, LOST] == ABSENT and _has_lost(x, pose):
                results[drive, LOST] = tick
            for channel in range(len(STATE_ROWS)):
                truth[lane, channel, tick] = memory[STATE_ROWS[channel] * LANES + lane]
            route, lost = routes[drive], results[drive, LOST] != ABSENT
            entry, fraction = locate(route, pose.station)
            path = _preview(roads, route, x, pose.station, entry, fraction, lost)
            write(memory, PATH, lane, path)
            _update_environment(memory, lane, surfaces, entry, fraction)
    decide_lanes(memory)


@kernel
def finish_sample(routes: Any, memory: Any, lane_table: Any, truth: Any, results: Any) -> int:
    """Record forces and angles, count samples and laps; return the number of ended drives."""
    ended = 0
    for lane in range(LANES):
        drive, tick = lane_table[DRIVE, lane], lane_table[TICK, lane]
        if drive != ABSENT:
            route = routes[drive]
            for channel in range(len(STEP_ROWS)):
                value = memory[STEP_ROWS[channel] * LANES + lane]
                truth[lane, len(STATE_ROWS) + channel, tick] = value
            station = memory[POSE * LANES + lane]
            distance_m = lane_table[LAP, lane] * route.length_m + station
            if route.closed:
                lap = 1 if station >= route.length_m else -1 if station < 0.0 else 0
                lane_table[LAP, lane] += lap
                memory[POSE * LANES + lane] = station - lap * route.length_m
            lane_table[TICK, lane] = tick + 1
            lost = results[drive, LOST]
            given_up = lost != ABSENT and tick >= lost + SAMPLES_AFTER_LOSS
            if given_up or distance_m >= route.distance_m or tick + 1 == route.samples:
                results[drive, SAMPLES] = tick + 1
                ended += 1
    return ended


@kernel
def simulate_lanes(
    routes: Any,
    roads: Any,
    surfaces: Any,
    steps: int,
    memory: Any,
    lane_table: Any,
    truth: Any,
    results: Any,
) -> None:
    """Simulate sample by sample until a drive ends.

    At least one lane must carry a drive.

    Parameters
    ----------
    routes
        One `ROUTE` for each drive: its rows in `roads` and `surfaces`, and its limits.
    roads
        Curvature, target speed and target acceleration, shape (entries, 3).
    surfaces
        Fields of `Surface`, shape (entries, 5).
    steps
        Integration steps for each sample.
    memory, lane_table
        Lanes, as `empty_lanes` returns them; updated.
    truth
        Channels of the drive of each lane, shape (lanes, channels, samples); written.
    results
        Number of samples and tick of the loss of each drive, shape (drives, 2); written.
    """
    ended = 0
    while ended == 0:
        begin_sample(routes, roads, surfaces, memory, lane_table, truth, results)
        for step in range(steps):
            integrate_lanes(memory, SAMPLE_S / steps, step == 0)
        ended = finish_sample(routes, memory, lane_table, truth, results)


# Roads and drives.

MAX_PREVIEW_M = 20.0
"""Length of the table of a closed road beyond a lap's end, in m: the driver's preview."""


class Surface(NamedTuple):
    """Slopes, adhesion and wind at the entries of a road, arrays of shape (m,)."""

    gravity_x_mps2: FloatArray
    """Component of gravity along the road; negative uphill."""
    gravity_y_mps2: FloatArray
    """Component of gravity across the road, positive to the left."""
    grip_left: FloatArray
    """Adhesion under the left wheels over the adhesion of the drive."""
    grip_right: FloatArray
    """Adhesion under the right wheels over the adhesion of the drive."""
    cross_wind_mps: FloatArray
    """Speed of the air across the road, positive to the left."""


class Road(NamedTuple):
    """A line to follow and the speed to hold, at equal steps of the station from 0.

    The length of a closed road is a whole number of spacings. Its last entry is followed by the
    first.
    """

    spacing_m: float
    curvature_1pm: FloatArray
    """Curvature of the line, (m,), positive to the left."""
    speed_mps: FloatArray
    """Target speed, (m,), including the speed factor of the drive."""
    length_m: float
    closed: bool
    surface: Surface | None = None
    """None: flat, even and calm."""


def planned_time_s(road: Road, distance_m: float) -> float:
    """Return the time that a distance takes at the road's target speed."""
    speed = np.append(road.speed_mps, road.speed_mps[0]) if road.closed else road.speed_mps
    lap_s = float(np.sum(2 * road.spacing_m / (speed[:-1] + speed[1:])))
    return lap_s * distance_m / road.length_m


def target_acceleration(road: Road) -> FloatArray:
    """Return d(v²/2)/ds of the target speed at the entries in m/s², by central differences."""
    energy = road.speed_mps**2 / 2
    if road.closed:
        return (np.roll(energy, -1) - np.roll(energy, 1)) / (2 * road.spacing_m)
    return np.gradient(energy, road.spacing_m)


def _table(road: Road, *columns: FloatArray) -> FloatArray:
    """Stack columns of a road; those of a closed road continue beyond the lap's end."""
    extra = math.ceil(MAX_PREVIEW_M / road.spacing_m) + 1 if road.closed else 0
    return np.take(np.stack(columns, axis=1), range(len(columns[0]) + extra), axis=0, mode="wrap")


def _surface_table(road: Road) -> FloatArray:
    zeros, ones = np.zeros(len(road.curvature_1pm)), np.ones(len(road.curvature_1pm))
    return _table(road, *(road.surface or Surface(zeros, zeros, ones, ones, zeros)))


def require_valid_road(road: Road) -> None:
    """Raise `ConfigError` if the tables of a road are not valid."""
    entries = len(road.curvature_1pm)
    intervals = entries if road.closed else entries - 1
    columns = (road.curvature_1pm, road.speed_mps, *(road.surface or ()))
    problems = {
        "missing or infinite entries of curvature, speed or surface": entries < 2
        or any(len(c) != entries or not np.isfinite(c).all() for c in columns),
        f"{intervals} intervals of {road.spacing_m} m, but a length of {road.length_m} m": abs(
            intervals * road.spacing_m - road.length_m
        )
        > 1e-6 * road.length_m,
        f"target speeds that are not above {LOST_SPEED_MPS} m/s": (
            road.speed_mps <= LOST_SPEED_MPS
        ).any(),
    }
    for problem, is_present in problems.items():
        if is_present:
            raise ConfigError(f"the road has {problem}. Correct its tables.")


STEPS_PER_SAMPLE = round(SAMPLE_S / STEP_S)

MAX_TIME_FACTOR = 1.25
"""A drive ends after this multiple of its planned time, plus `EXTRA_TIME_S`."""

EXTRA_TIME_S = 5.0
"""Time in s that every drive may take beyond `MAX_TIME_FACTOR`: short drives start slowly."""


@dataclass(frozen=True)
class LaneDrive:
    """A drive to simulate. It starts at station 0, on the line, at the road's target speed."""

    vehicle: VehicleParameters
    road: Road
    adhesion: float
    """Adhesion coefficient μ of the road, 1 on dry asphalt."""
    laps: float
    """Length of the drive in lengths of the road."""
    flaws: CarImperfections = PERFECT


@dataclass(frozen=True)
class Truth:
    """The true motion of a car in a drive: arrays of `CHANNELS`, and the tick of a loss if any."""

    drive: int
    channels: dict[str, FloatArray]
    lost_control_tick: int | None


def simulate_drives(
    drives: Sequence[LaneDrive],
    steps_per_sample: int = STEPS_PER_SAMPLE,
    simulate_lanes: Callable[..., None] = simulate_lanes,
) -> Iterator[Truth]:
    """Simulate drives, sampled at 100 Hz from their start.

    A drive ends after its laps, at the end of an open road, `SAMPLES_AFTER_LOSS` samples after a
    loss of control, or after `MAX_TIME_FACTOR` times the planned time. Its bits depend on the drive
    alone, not on other drives, threads or the machine. The GIL is released.

    Parameters
    ----------
    drives
        The drives. Memory is that of `LANES` drives of the longest time.
    steps_per_sample
        Integration steps of each sample of 10 ms.
    simulate_lanes
        The loop over time and lanes: the kernel, or `highway.HighwayLanes` of these drives.

    Yields
    ------
    Truth
        The drives in the order in which they end.

    Raises
    ------
    ConfigError
        If a road, an adhesion or a number of laps is not valid.
    """
    for drive in drives:
        require_valid_road(drive.road)
        if not 0 < drive.adhesion < math.inf or not 0 < drive.laps < math.inf:
            raise ConfigError(
                f"adhesion {drive.adhesion} and laps {drive.laps}: give positive numbers."
            )
    if not drives:
        return
    routes, roads, surfaces = _routes(drives)
    waiting = np.argsort(routes["samples"], kind="stable").tolist()
    results = np.full((len(drives), 2), ABSENT)
    memory, lane_table = empty_lanes()
    channels = np.empty((LANES, len(CHANNELS), routes["samples"].max()))
    while True:
        for lane in np.flatnonzero(lane_table[DRIVE] == ABSENT)[: len(waiting)]:
            index = waiting.pop()
            speed_mps = roads[routes["first"][index], SPEED]
            start_drive(memory, lane_table, lane, index, _car(drives[index]), speed_mps)
        if (lane_table[DRIVE] == ABSENT).all():
            return
        simulate_lanes(
            routes, roads, surfaces, steps_per_sample, memory, lane_table, channels, results
        )
        for lane, index in enumerate(lane_table[DRIVE].tolist()):
            samples, lost = results[index].tolist()
            if ABSENT not in (index, samples):
                values = channels[lane, :, :samples].copy()
                truth = dict(zip(CHANNELS, values, strict=True))
                yield Truth(index, truth, None if lost == ABSENT else lost)
                vacate(memory, lane_table, lane)


def _car(drive: LaneDrive) -> FloatArray:
    """Return `Constants`, `Handling` and `ImperfectionConstants` in the kernel's order."""
    compliance_rad_per_n = math.radians(drive.flaws.steering_compliance_deg_per_kn) / 1000
    return np.array(
        [
            *constants(drive.vehicle, drive.adhesion),
            *handling(drive.vehicle, compliance_rad_per_n),
            *imperfection_constants(drive.vehicle, drive.flaws, SAMPLE_S),
        ]
    )


def _routes(drives: Sequence[LaneDrive]) -> tuple[NDArray[np.void], FloatArray, FloatArray]:
    """Return the route of each drive, and the tables of all roads and surfaces."""
    roads = {id(drive.road): drive.road for drive in drives}
    tables = [
        _table(road, road.curvature_1pm, road.speed_mps, target_acceleration(road))
        for road in roads.values()
    ]
    ends = np.cumsum([len(table) for table in tables])
    spans = dict(zip(roads, zip([0, *ends[:-1]], ends - 1, strict=True), strict=True))
    routes = np.empty(len(drives), dtype=ROUTE)
    for i, drive in enumerate(drives):
        road = drive.road
        distance_m = (drive.laps if road.closed else min(drive.laps, 1.0)) * road.length_m
        limit_s = MAX_TIME_FACTOR * planned_time_s(road, distance_m) + EXTRA_TIME_S
        limits = road.length_m, road.closed, distance_m, math.ceil(limit_s / SAMPLE_S)
        routes[i] = *spans[id(road)], 1 / road.spacing_m, *limits
    surfaces = [_surface_table(road) for road in roads.values()]
    return routes, np.concatenate(tables), np.concatenate(surfaces)
