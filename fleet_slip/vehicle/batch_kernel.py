"""The compiled loop over time and lanes; each lane carries one drive after the other.

At every sample a scalar part reads the road and records the truth. Driver and physics are loops
over all lanes, which compile to vector instructions. The loop returns when a block is full or a
drive ends.
"""

import math
from collections.abc import Callable
from itertools import accumulate
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.vehicle.driver import (
    SAMPLE_S,
    SPEED_PREVIEW_S,
    STEERING_PREVIEW_S,
    Handling,
    decide,
)
from fleet_slip.vehicle.dynamics import (
    Compliance,
    ComplianceRates,
    Environment,
    arctan2,
    front_wheels,
)
from fleet_slip.vehicle.integration import (
    SECOND_ORDER,
    Motion,
    Path,
    Pose,
    PoseSlopes,
    Slopes,
    advance_car,
)
from fleet_slip.vehicle.parameters import Constants, Controls, ImperfectionConstants, State

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

DRIVE, TICK, LAP, FIRST = range(4)
"""Rows of the lane table: drive, tick of the next sample, lap, and first tick of the block."""

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
    return np.zeros(ROWS * LANES), np.full((4, LANES), ABSENT)


def start_drive(
    memory: FloatArray,
    lane_table: IntArray,
    lane: int,
    drive: int,
    car: FloatArray,
    speed_mps: float,
) -> None:
    """Start a drive on a lane: the car rolls straight along the line, on cold tyres."""
    lane_table[:, lane] = drive, 0, 0, 0
    spin = speed_mps * car[INVERSE_RADIUS]
    column = memory.reshape(ROWS, LANES)[:, lane]
    column[:] = 0.0
    column[CAR : CAR + len(car)] = car
    column[STATE : STATE + len(State._fields)] = State(speed_mps, *6 * (0.0,), *4 * (spin,))
    column[POSE : POSE + len(Pose._fields)] = Pose(0.0, 0.0, 1.0, 0.0)
    cold = column[IMPERFECTION_CONSTANTS + ImperfectionConstants._fields.index("cold_stiffness")]
    column[ENVIRONMENT : ENVIRONMENT + len(Environment._fields)] = Environment(
        0.0, 0.0, 1.0, 1.0, 0.0, 1.0 + cold
    )


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

BLOCK = 2**16
"""Samples of a block: 11 minutes of a drive. Its channels fit into the processor's cache."""

STRIDE = BLOCK + 8
"""Distance between two channels of a block. With a power of two, all channels would compete for
the same lines of the processor's cache."""


def empty_blocks() -> tuple[FloatArray, FloatArray]:
    """Return memory for the blocks of all lanes, flat and in shape (lane, channel, sample)."""
    memory = np.empty(LANES * len(CHANNELS) * STRIDE)
    return memory, memory.reshape(LANES, len(CHANNELS), STRIDE)


@equation
def block_index(lane: int, channel: int, sample: int) -> int:
    """Return the index of a sample of a channel in the blocks."""
    return (lane * len(CHANNELS) + channel) * STRIDE + sample


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
def _record(
    memory: Any, lane_table: Any, routes: Any, roads: Any, surfaces: Any, truth: Any, results: Any
) -> None:
    """Record the state of all cars and read their roads; `_finish_sample` records the forces."""
    for lane in range(LANES):
        drive, tick = lane_table[DRIVE, lane], lane_table[TICK, lane]
        if drive != ABSENT:
            x = read(memory, STATE, lane, State)
            pose = read(memory, POSE, lane, Pose)
            if results[drive, LOST] == ABSENT and _has_lost(x, pose):
                results[drive, LOST] = tick
            sample = tick - lane_table[FIRST, lane]
            for channel in range(len(STATE_ROWS)):
                value = memory[STATE_ROWS[channel] * LANES + lane]
                truth[block_index(lane, channel, sample)] = value
            route, lost = routes[drive], results[drive, LOST] != ABSENT
            entry, fraction = locate(route, pose.station)
            path = _preview(roads, route, x, pose.station, entry, fraction, lost)
            write(memory, PATH, lane, path)
            _update_environment(memory, lane, surfaces, entry, fraction)


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


@equation
def _finish_sample(memory: Any, lane_table: Any, routes: Any, truth: Any, results: Any) -> int:
    """Record forces and angles, count samples and laps; return the number of complete blocks."""
    complete = 0
    for lane in range(LANES):
        drive, tick = lane_table[DRIVE, lane], lane_table[TICK, lane]
        if drive != ABSENT:
            route = routes[drive]
            sample = tick - lane_table[FIRST, lane]
            for channel in range(len(STEP_ROWS)):
                value = memory[STEP_ROWS[channel] * LANES + lane]
                truth[block_index(lane, len(STATE_ROWS) + channel, sample)] = value
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
                complete += 1
            elif sample + 1 == BLOCK:
                complete += 1
    return complete


@kernel
def begin_sample(
    routes: Any, roads: Any, surfaces: Any, memory: Any, lane_table: Any, truth: Any, results: Any
) -> None:
    """Record the state of all cars, and compute the demands of their drivers."""
    _record(memory, lane_table, routes, roads, surfaces, truth, results)
    decide_lanes(memory)


@kernel
def finish_sample(routes: Any, memory: Any, lane_table: Any, truth: Any, results: Any) -> int:
    """Record forces and angles, count samples and laps; return the number of complete blocks."""
    return _finish_sample(memory, lane_table, routes, truth, results)


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
    """Simulate sample by sample until the block of a lane is complete.

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
        Blocks, as `empty_blocks` returns them; written.
    results
        Number of samples and tick of the loss of each drive, shape (drives, 2); written.
    """
    complete = 0
    while complete == 0:
        _record(memory, lane_table, routes, roads, surfaces, truth, results)
        decide_lanes(memory)
        for step in range(steps):
            integrate_lanes(memory, SAMPLE_S / steps, step == 0)
        complete = _finish_sample(memory, lane_table, routes, truth, results)
