"""The compiled loop over time and lanes, each of which carries one drive after the other.

At every sample the scalar part looks up the road and records; driver and physics are loops over all
lanes, vector instructions. When a block is full or its drive ends, the caller takes it.
"""

import math
from collections.abc import Callable
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
    NO_BRAKES,
    Around,
    Give,
    GiveRates,
    front_wheels,
    imperfect_derivative,
)
from fleet_slip.vehicle.integration import (
    SECOND_ORDER,
    Path,
    Pose,
    PoseSlopes,
    Slopes,
    advance,
    advance_give,
    advance_pose,
    pose_slopes,
)
from fleet_slip.vehicle.parameters import Constants, Controls, State, Traits
from fleet_slip.vehicle.tyre import arctan2

# Lanes in memory: what each carries, how a drive enters and leaves it, and the blocks it records.
#
# Every quantity is a row of `LANES` numbers in one flat array, at offsets known when compiling:
# loops over lanes become vector instructions. Blocks are measured from the processor's cache.

LANES = 8
"""Lanes of the kernel: one or two of a processor's vectors."""


def _address(context: Any, builder: Any, array_type: Any, args: Any, index: int) -> Any:
    """Emit the address of the `index`-th row after a first row, at a lane."""
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
"""Return one lane of successive rows as a named tuple: `read(memory, ROW, lane, State)`."""

write: Callable[..., None] = _write
"""Write a tuple of floats to one lane of successive rows: `write(memory, ROW, lane, values)`."""


ROUTE = np.dtype(
    [
        ("first", np.int64),  # index of the road's first entry in the table of all roads
        ("last", np.int64),
        ("inverse_spacing", np.float64),
        ("length_m", np.float64),
        ("closed", np.bool_),
        ("distance_m", np.float64),
        ("samples", np.int64),  # most that the drive may take
    ]
)


@equation
def place(route: Any, station: float) -> tuple[int, float]:
    """Return the entry at or before a station, and how far the next is; closed roads go on."""
    entries = station * route.inverse_spacing
    entry = min(max(math.floor(entries), 0), route.last - route.first - 1)
    return route.first + entry, min(max(entries - entry, 0.0), 1.0)


NOBODY = -1
"""Drive of a lane that has none, and tick of a loss that has not happened."""

DRIVE, TICK, LAP, FIRST = range(4)
"""Rows of the book of lanes: which drive a lane carries, its next sample, its lap, and the tick of
the first sample of its block."""

STATE = 0
"""First row of a named tuple in the memory; the next follow."""
SLOPES = STATE + len(State._fields)
POSE = SLOPES + len(Slopes._fields)
POSE_SLOPES = POSE + len(Pose._fields)
CONTROLS = POSE_SLOPES + len(PoseSlopes._fields)
PATH = CONTROLS + len(Controls._fields)
FORCE = PATH + len(Path._fields)
"""Specific force ax, ay at the sample."""
ANGLES = FORCE + 2
"""Angles of the front wheels, and the side-slip angle, at the sample."""
ORDER = ANGLES + 3
"""Extrapolation of the integration: 0 in a drive's first step."""
CAR = ORDER + 1
HANDLING = CAR + len(Constants._fields)
TRAITS = HANDLING + len(Handling._fields)
AROUND = TRAITS + len(Traits._fields)
GIVE = AROUND + len(Around._fields)
GIVE_SLOPES = GIVE + len(Give._fields)
ROWS = GIVE_SLOPES + len(GiveRates._fields)

INVERSE_RADIUS = Constants._fields.index("inverse_radius")


def empty_lanes() -> tuple[FloatArray, IntArray]:
    """Return the memory and the book of lanes without a drive: cars at rest."""
    return np.zeros(ROWS * LANES), np.full((4, LANES), NOBODY)


def begin(
    memory: FloatArray, book: IntArray, lane: int, drive: int, car: FloatArray, speed_mps: float
) -> None:
    """Put a drive on a lane: rolling straight along the line at a speed, on cold tyres."""
    book[:, lane] = drive, 0, 0, 0
    spin = speed_mps * car[INVERSE_RADIUS]
    column = memory.reshape(ROWS, LANES)[:, lane]
    column[:] = 0.0
    column[CAR : CAR + len(car)] = car
    column[STATE : STATE + len(State._fields)] = State(speed_mps, *6 * (0.0,), *4 * (spin,))
    column[POSE : POSE + len(Pose._fields)] = Pose(0.0, 0.0, 1.0, 0.0)
    cold = column[TRAITS + Traits._fields.index("cold_stiffness")]
    column[AROUND : AROUND + len(Around._fields)] = Around(0.0, 0.0, 1.0, 1.0, 0.0, 1.0 + cold)


def clear(memory: FloatArray, book: IntArray, lane: int) -> None:
    """Let nothing stand on a lane: a car at rest."""
    book[DRIVE, lane] = NOBODY
    memory.reshape(ROWS, LANES)[:, lane] = 0.0


CHANNELS = (
    "ax_mps2",
    "ay_mps2",
    "yaw_rate_rad_s",
    "steering_wheel_rad",
    "wheel_fl_rad_s",
    "wheel_fr_rad_s",
    "wheel_rl_rad_s",
    "wheel_rr_rad_s",
    "steer_fl_rad",
    "steer_fr_rad",
    "sideslip_rad",
    "vx_mps",
    "vy_mps",
    "station_m",
    "lateral_offset_m",
    "yaw_acceleration_rad_s2",
    "leaning_ax_mps2",
    "leaning_ay_mps2",
)
"""What a lane records; the last three for sensors: how the body begins to turn, and the
accelerations as its pitch and roll have followed them."""

BLOCK = 2**16
"""Samples of a block: 11 minutes of a drive."""

STRIDE = BLOCK + 8
"""Distance between two channels of a block: with a power of two all channels would share the same
few lines of the processor's cache."""


def empty_blocks() -> tuple[FloatArray, FloatArray]:
    """Return memory for the blocks of all lanes, flat, and in its shape (lane, channel, sample)."""
    memory = np.empty(LANES * len(CHANNELS) * STRIDE)
    return memory, memory.reshape(LANES, len(CHANNELS), STRIDE)


@equation
def at(lane: int, channel: int, sample: int) -> int:
    """Return where a sample of a channel stands in the blocks."""
    return (lane * len(CHANNELS) + channel) * STRIDE + sample


AFTER_LOSS = 500
"""Samples that a drive goes on after the driver lost the car: 5 s."""
LOST_OFFSET_M = 10.0
LOST_SLIP_TANGENT = math.sqrt(3.0)
"""Side-slip of 60°."""
LOST_SPEED_MPS = 0.5

CURVATURE, SPEED, ACCELERATION = range(3)
"""Columns of the table of all roads: curvature, target speed, target acceleration."""

SAMPLES, LOST = range(2)
"""Columns of the result: number of samples of a drive, and the tick of its loss or `NOBODY`."""


@equation
def _look_up(
    roads: Any, route: Any, x: State, station: float, here: int, share: float, lost: bool
) -> Path:
    """Return what the driver sees of the road from a station, `share` of the way after `here`."""
    curvature = roads[here, CURVATURE]
    change = roads[here + 1, CURVATURE] - curvature
    ahead, part = place(route, station + STEERING_PREVIEW_S * x.vx)
    soon, bit = place(route, station + SPEED_PREVIEW_S * x.vx)
    return Path(
        station,
        curvature + share * change,
        change * route.inverse_spacing,
        (1.0 - part) * roads[ahead, CURVATURE] + part * roads[ahead + 1, CURVATURE],
        (1.0 - bit) * roads[soon, SPEED] + bit * roads[soon + 1, SPEED],
        (1.0 - bit) * roads[soon, ACCELERATION] + bit * roads[soon + 1, ACCELERATION],
        1.0 if lost else 0.0,
    )


@equation
def _look_around(memory: Any, lane: int, surfaces: Any, here: int, share: float) -> None:
    """Look up road and air where a car is, and warm its tyres."""
    for column in range(5):
        before, after = surfaces[here, column], surfaces[here + 1, column]
        memory[(AROUND + column) * LANES + lane] = before + share * (after - before)
    cooling = read(memory, TRAITS, lane, Traits).cooling
    stiffness = (AROUND + 5) * LANES + lane
    memory[stiffness] = 1.0 + (memory[stiffness] - 1.0) * cooling


@equation
def _has_lost(x: State, pose: Pose) -> bool:
    """Whether the car has left the road, spun or stopped."""
    return (
        abs(pose.offset) > LOST_OFFSET_M
        or abs(x.vy) > LOST_SLIP_TANGENT * x.vx
        or x.vx < LOST_SPEED_MPS
    )


@equation
def _look(
    memory: Any, book: Any, routes: Any, roads: Any, surfaces: Any, truth: Any, ended: Any
) -> None:
    """Record where all cars are, but for what the next step gives, and look up their roads."""
    for lane in range(LANES):
        drive, tick = book[DRIVE, lane], book[TICK, lane]
        if drive != NOBODY:
            x = read(memory, STATE, lane, State)
            pose = read(memory, POSE, lane, Pose)
            if ended[drive, LOST] == NOBODY and _has_lost(x, pose):
                ended[drive, LOST] = tick
            sample = tick - book[FIRST, lane]
            truth[at(lane, 2, sample)] = x.yaw_rate
            truth[at(lane, 3, sample)] = x.steering_wheel
            truth[at(lane, 4, sample)] = x.wheel_fl
            truth[at(lane, 5, sample)] = x.wheel_fr
            truth[at(lane, 6, sample)] = x.wheel_rl
            truth[at(lane, 7, sample)] = x.wheel_rr
            truth[at(lane, 11, sample)] = x.vx
            truth[at(lane, 12, sample)] = x.vy
            truth[at(lane, 13, sample)] = pose.station
            truth[at(lane, 14, sample)] = pose.offset
            truth[at(lane, 15, sample)] = read(memory, SLOPES, lane, Slopes).yaw_rate
            truth[at(lane, 16, sample)] = x.ax_lag
            truth[at(lane, 17, sample)] = x.ay_lag
            route, lost = routes[drive], ended[drive, LOST] != NOBODY
            here, share = place(route, pose.station)
            path = _look_up(roads, route, x, pose.station, here, share, lost)
            write(memory, PATH, lane, path)
            _look_around(memory, lane, surfaces, here, share)


@equation
def decide_all(memory: Any) -> None:
    """Let all drivers decide, and note the angles at the sample."""
    for lane in range(LANES):
        x = read(memory, STATE, lane, State)
        pose = read(memory, POSE, lane, Pose)
        path = read(memory, PATH, lane, Path)
        before = read(memory, CONTROLS, lane, Controls)
        h = read(memory, HANDLING, lane, Handling)
        c = read(memory, CAR, lane, Constants)
        t = read(memory, TRAITS, lane, Traits)
        give = read(memory, GIVE, lane, Give)
        (along_l, across_l), (along_r, across_r) = front_wheels(give, c, t)
        angles = arctan2(across_l, along_l), arctan2(across_r, along_r), arctan2(x.vy, x.vx)
        write(memory, ANGLES, lane, angles)
        write(memory, CONTROLS, lane, decide(x, pose, path, before, h, c))


@equation
def integrate(memory: Any, step_s: float, first_step: bool) -> None:
    """Move all cars on; keep the specific force at the first step of a sample."""
    for lane in range(LANES):
        x = read(memory, STATE, lane, State)
        u = read(memory, CONTROLS, lane, Controls)
        c = read(memory, CAR, lane, Constants)
        t = read(memory, TRAITS, lane, Traits)
        pose = read(memory, POSE, lane, Pose)
        path = read(memory, PATH, lane, Path)
        around = read(memory, AROUND, lane, Around)
        give = read(memory, GIVE, lane, Give)
        order = memory[ORDER * LANES + lane]
        d, rates = imperfect_derivative(x, u, give, around, NO_BRAKES, c, t)
        after, slopes = advance(x, d, read(memory, SLOPES, lane, Slopes), c, step_s, order)
        before = read(memory, GIVE_SLOPES, lane, GiveRates)
        given = advance_give(give, rates, before, after.steering_wheel, t, step_s, order)
        pose_before = read(memory, POSE_SLOPES, lane, PoseSlopes)
        travel = pose_slopes(x, pose, path)
        ax = d.ax if first_step else memory[FORCE * LANES + lane]
        ay = d.ay if first_step else memory[(FORCE + 1) * LANES + lane]
        write(memory, STATE, lane, after)
        write(memory, SLOPES, lane, slopes)
        write(memory, GIVE, lane, given)
        write(memory, GIVE_SLOPES, lane, rates)
        write(memory, POSE, lane, advance_pose(pose, travel, pose_before, step_s, order))
        write(memory, POSE_SLOPES, lane, travel)
        write(memory, FORCE, lane, (ax, ay))
        memory[ORDER * LANES + lane] = SECOND_ORDER


@equation
def _move_on(memory: Any, book: Any, routes: Any, truth: Any, ended: Any) -> int:
    """Count the sample and the laps of all cars; return how many blocks are complete."""
    complete = 0
    for lane in range(LANES):
        drive, tick = book[DRIVE, lane], book[TICK, lane]
        if drive != NOBODY:
            route = routes[drive]
            sample = tick - book[FIRST, lane]
            truth[at(lane, 0, sample)] = memory[FORCE * LANES + lane]
            truth[at(lane, 1, sample)] = memory[(FORCE + 1) * LANES + lane]
            for angle in range(3):
                truth[at(lane, 8 + angle, sample)] = memory[(ANGLES + angle) * LANES + lane]
            station = memory[POSE * LANES + lane]
            gone = book[LAP, lane] * route.length_m + station
            if route.closed:
                lap = 1 if station >= route.length_m else -1 if station < 0.0 else 0
                book[LAP, lane] += lap
                memory[POSE * LANES + lane] = station - lap * route.length_m
            book[TICK, lane] = tick + 1
            lost = ended[drive, LOST]
            given_up = lost != NOBODY and tick >= lost + AFTER_LOSS
            if given_up or gone >= route.distance_m or tick + 1 == route.samples:
                ended[drive, SAMPLES] = tick + 1
                complete += 1
            elif sample + 1 == BLOCK:
                complete += 1
    return complete


@kernel
def simulate(
    routes: Any,
    roads: Any,
    surfaces: Any,
    steps: int,
    memory: Any,
    book: Any,
    truth: Any,
    ended: Any,
) -> None:
    """Drive on, from sample to sample, until a lane's block is complete; some lane has a drive.

    `routes` (`ROUTE`) point into `roads` and `surfaces`; a sample takes `steps` steps; `truth` is
    of `empty_blocks`; `ended` gets each drive's number of samples and tick of loss.
    """
    complete = 0
    while complete == 0:
        _look(memory, book, routes, roads, surfaces, truth, ended)
        decide_all(memory)
        for step in range(steps):
            integrate(memory, SAMPLE_S / steps, step == 0)
        complete = _move_on(memory, book, routes, truth, ended)
