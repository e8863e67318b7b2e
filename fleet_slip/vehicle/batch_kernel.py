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
from fleet_slip.vehicle.dynamics import derivative
from fleet_slip.vehicle.imperfections import (
    Around,
    Give,
    GiveRates,
    Traits,
    advance_give,
    imperfect_derivative,
    rack_tangent,
    wheel_tangent,
)
from fleet_slip.vehicle.integration import (
    SECOND_ORDER,
    Path,
    Pose,
    PoseSlopes,
    Slopes,
    advance,
    advance_pose,
    pose_slopes,
)
from fleet_slip.vehicle.parameters import Constants, Controls, State
from fleet_slip.vehicle.tyre import arctan2

# Lanes in memory: what each carries, how a drive enters and leaves it, and the blocks it records.
#
# Every quantity is a row of `LANES` numbers in one flat array, at offsets known when compiling:
# loops over lanes become vector instructions. Blocks are measured from the processor's cache.
#
# The physics of the lane kernel: what is around all cars, and how they move on by a step.

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
    result = types.NamedUniTuple(types.float64, count, fields)  # type: ignore[no-untyped-call]

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
ORDER = FORCE + 2
"""Extrapolation of the integration: 0 in a drive's first step."""
CAR = ORDER + 1
HANDLING = CAR + len(Constants._fields)
TRAITS = HANDLING + len(Handling._fields)
"""From here on only cars with imperfections use the memory."""
AROUND = TRAITS + len(Traits._fields)
GIVE = AROUND + len(Around._fields)
GIVE_SLOPES = GIVE + len(Give._fields)
ROWS = GIVE_SLOPES + len(GiveRates._fields)

STEER = Constants._fields.index("steer_per_wheel")
ACKERMANN = Constants._fields.index("ackermann")
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
)

IMPERFECT_CHANNELS = ("yaw_acceleration_rad_s2", "leaning_ax_mps2", "leaning_ay_mps2")
"""What a lane records besides of a car with imperfections, for its sensors: how the body begins to
turn, and the accelerations as its pitch and roll have followed them."""

BLOCK = 2**16
"""Samples of a block: 11 minutes of a drive."""

STRIDE = BLOCK + 8
"""Distance between two channels of a block: with a power of two all channels would share the same
few lines of the processor's cache."""

BLOCK_SHAPE = (LANES, len(CHANNELS), STRIDE)


IMPERFECT_BLOCK_SHAPE = (LANES, len(IMPERFECT_CHANNELS), STRIDE)


def empty_blocks(imperfect: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return memory for the blocks of all lanes, flat, and its two parts in their shapes."""
    usual = LANES * len(CHANNELS) * STRIDE
    memory = np.empty(usual + (LANES * len(IMPERFECT_CHANNELS) * STRIDE if imperfect else 0))
    more = memory[usual:].reshape(IMPERFECT_BLOCK_SHAPE if imperfect else (LANES, 0, STRIDE))
    return memory, memory[:usual].reshape(BLOCK_SHAPE), more


@equation
def at(lane: int, channel: int, sample: int) -> int:
    """Return where a sample of a channel stands in the blocks."""
    return (lane * len(CHANNELS) + channel) * STRIDE + sample


@equation
def further_at(lane: int, channel: int, sample: int) -> int:
    """Return where a sample of one of `IMPERFECT_CHANNELS` stands in the blocks."""
    start = LANES * len(CHANNELS) * STRIDE
    return start + (lane * len(IMPERFECT_CHANNELS) + channel) * STRIDE + sample


@equation
def record(truth: Any, lane: int, sample: int, x: State, pose: Pose) -> None:
    """Write the sample that begins here, but for the specific force, which the next step gives."""
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


@equation
def fill_recorded_angles(left: Any, right: Any, vx: Any, vy: Any, slip: Any) -> None:
    """Fill in the angles of a block in which the wheels' tangents stand instead of their angles."""
    for tick in range(len(left)):
        left[tick] = arctan2(left[tick], 1.0)
    for tick in range(len(right)):
        right[tick] = arctan2(right[tick], 1.0)
    for tick in range(len(slip)):
        slip[tick] = arctan2(vy[tick], vx[tick])


@equation
def fill_angles(wheel: Any, left: Any, right: Any, vx: Any, vy: Any, slip: Any, car: Any) -> None:
    """Fill in the road wheels' angles and the side-slip angle of a block."""
    steer, ackermann = car[STEER], car[ACKERMANN]
    for tick in range(len(wheel)):
        tangent = steer * wheel[tick]
        left[tick] = arctan2(tangent, 1.0 - ackermann * tangent)
    for tick in range(len(wheel)):
        tangent = steer * wheel[tick]
        right[tick] = arctan2(tangent, 1.0 + ackermann * tangent)
    for tick in range(len(wheel)):
        slip[tick] = arctan2(vy[tick], vx[tick])


@equation
def _wheel_tangents(give: Give, c: Constants, t: Traits) -> tuple[float, float]:
    tangent = rack_tangent(give, c, t)
    bend = c.ackermann * tangent
    along_l, across_l = wheel_tangent(tangent, 1.0 - bend, -t.toe)
    along_r, across_r = wheel_tangent(tangent, 1.0 + bend, t.toe)
    return across_l / along_l, across_r / along_r


@equation
def look_around(memory: Any, book: Any, routes: Any, surfaces: Any, truth: Any) -> None:
    """Look up road and air where all cars are, warm their tyres, and record what sensors feel."""
    for lane in range(LANES):
        drive = book[DRIVE, lane]
        if drive != NOBODY:
            x = read(memory, STATE, lane, State)
            pose = read(memory, POSE, lane, Pose)
            t = read(memory, TRAITS, lane, Traits)
            near = read(memory, AROUND, lane, Around)
            here, share = place(routes[drive], pose.station)
            for column in range(5):
                before, after = surfaces[here, column], surfaces[here + 1, column]
                memory[(AROUND + column) * LANES + lane] = before + share * (after - before)
            memory[(AROUND + 5) * LANES + lane] = 1.0 + (near.stiffness - 1.0) * t.cooling
            c = read(memory, CAR, lane, Constants)
            give = read(memory, GIVE, lane, Give)
            left, right = _wheel_tangents(give, c, t)
            sample = book[TICK, lane] - book[FIRST, lane]
            truth[at(lane, 8, sample)] = left
            truth[at(lane, 9, sample)] = right
            truth[further_at(lane, 0, sample)] = read(memory, SLOPES, lane, Slopes).yaw_rate
            truth[further_at(lane, 1, sample)] = x.ax_lag
            truth[further_at(lane, 2, sample)] = x.ay_lag


def _build_integrate(imperfect: bool) -> Callable[[Any, float, bool], None]:
    @equation
    def integrate(memory: Any, step_s: float, first_step: bool) -> None:
        """Move all cars on; keep the specific force at the first step of a sample."""
        for lane in range(LANES):
            x = read(memory, STATE, lane, State)
            u = read(memory, CONTROLS, lane, Controls)
            c = read(memory, CAR, lane, Constants)
            pose = read(memory, POSE, lane, Pose)
            path = read(memory, PATH, lane, Path)
            order = memory[ORDER * LANES + lane]
            if imperfect:
                t = read(memory, TRAITS, lane, Traits)
                around = read(memory, AROUND, lane, Around)
                give = read(memory, GIVE, lane, Give)
                d, give_rates = imperfect_derivative(x, u, give, around, c, t)
            else:
                d = derivative(x, u, c)
            after, slopes = advance(x, d, read(memory, SLOPES, lane, Slopes), c, step_s, order)
            if imperfect:
                before = read(memory, GIVE_SLOPES, lane, GiveRates)
                followed = advance_give(
                    give, give_rates, before, after.steering_wheel, t, step_s, order
                )
            pose_before = read(memory, POSE_SLOPES, lane, PoseSlopes)
            travel = pose_slopes(x, pose, path)
            ax = d.ax if first_step else memory[FORCE * LANES + lane]
            ay = d.ay if first_step else memory[(FORCE + 1) * LANES + lane]
            write(memory, STATE, lane, after)
            write(memory, SLOPES, lane, slopes)
            if imperfect:
                write(memory, GIVE, lane, followed)
                write(memory, GIVE_SLOPES, lane, give_rates)
            write(memory, POSE, lane, advance_pose(pose, travel, pose_before, step_s, order))
            write(memory, POSE_SLOPES, lane, travel)
            write(memory, FORCE, lane, (ax, ay))
            memory[ORDER * LANES + lane] = SECOND_ORDER

    return integrate


integrate = _build_integrate(imperfect=False)

integrate_imperfect = _build_integrate(imperfect=True)

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
def _look_up(roads: Any, route: Any, x: State, station: float, lost: bool) -> Path:
    """Return what the driver sees of the road from a station."""
    here, share = place(route, station)
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
def _decide(memory: Any) -> None:
    """Let all drivers decide."""
    for lane in range(LANES):
        x = read(memory, STATE, lane, State)
        pose = read(memory, POSE, lane, Pose)
        path = read(memory, PATH, lane, Path)
        before = read(memory, CONTROLS, lane, Controls)
        h = read(memory, HANDLING, lane, Handling)
        c = read(memory, CAR, lane, Constants)
        write(memory, CONTROLS, lane, decide(x, pose, path, before, h, c))


@equation
def _has_lost(x: State, pose: Pose) -> bool:
    """Whether the car has left the road, spun or stopped."""
    return (
        abs(pose.offset) > LOST_OFFSET_M
        or abs(x.vy) > LOST_SLIP_TANGENT * x.vx
        or x.vx < LOST_SPEED_MPS
    )


@equation
def _look(memory: Any, book: Any, routes: Any, roads: Any, truth: Any, ended: Any) -> None:
    """Record where all cars are and look up the road before them."""
    for lane in range(LANES):
        drive, tick = book[DRIVE, lane], book[TICK, lane]
        if drive != NOBODY:
            x = read(memory, STATE, lane, State)
            pose = read(memory, POSE, lane, Pose)
            if ended[drive, LOST] == NOBODY and _has_lost(x, pose):
                ended[drive, LOST] = tick
            record(truth, lane, tick - book[FIRST, lane], x, pose)
            lost = ended[drive, LOST] != NOBODY
            write(memory, PATH, lane, _look_up(roads, routes[drive], x, pose.station, lost))


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


@equation
def _finish(truth: Any, book: Any, ended: Any, cars: Any, imperfect: bool) -> None:
    """Fill in what follows from the recorded in the blocks that are complete."""
    for lane in range(LANES):
        drive, samples = book[DRIVE, lane], book[TICK, lane] - book[FIRST, lane]
        if drive != NOBODY and (samples == BLOCK or ended[drive, SAMPLES] != NOBODY):
            wheel = truth[at(lane, 3, 0) :][:samples]
            left, right = truth[at(lane, 8, 0) :][:samples], truth[at(lane, 9, 0) :][:samples]
            slip = truth[at(lane, 10, 0) :][:samples]
            vx, vy = truth[at(lane, 11, 0) :][:samples], truth[at(lane, 12, 0) :][:samples]
            if imperfect:
                fill_recorded_angles(left, right, vx, vy, slip)
            else:
                fill_angles(wheel, left, right, vx, vy, slip, cars[drive])


def build_kernel(imperfect: bool = False) -> Callable[..., None]:
    """Return the kernel, not yet compiled: of cars as in the textbook, or with imperfections.

    Its closure is part of numba's key on disk. A compiled function in it would have another
    identity in each process, and never be found.
    """

    def simulate(
        routes: Any,
        cars: Any,
        roads: Any,
        surfaces: Any,
        steps: int,
        memory: Any,
        book: Any,
        truth: Any,
        ended: Any,
    ) -> None:
        """Drive on, from sample to sample, until a lane's block is complete; some lane has a drive.

        `routes` (`ROUTE`) point into `roads` and `surfaces`; `cars` has `Constants`, `Handling` and
        `Traits` in rows; a sample takes `steps` steps; `truth` is of `empty_blocks`; `ended` gets
        each drive's number of samples and tick of loss.
        """
        complete = 0
        while complete == 0:
            _look(memory, book, routes, roads, truth, ended)
            if imperfect:
                look_around(memory, book, routes, surfaces, truth)
            _decide(memory)
            for step in range(steps):
                if imperfect:
                    integrate_imperfect(memory, SAMPLE_S / steps, step == 0)
                else:
                    integrate(memory, SAMPLE_S / steps, step == 0)
            complete = _move_on(memory, book, routes, truth, ended)
        _finish(truth, book, ended, cars, imperfect)

    return simulate


simulate = kernel(build_kernel())

simulate_imperfect = kernel(build_kernel(imperfect=True))
