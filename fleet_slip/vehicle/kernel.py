"""The compiled loop over time and lanes.

Each lane carries one drive; a lane whose drive has ended takes the next one. At every sample the
scalar part looks up the road and records; the driver's law and the physics are loops over all lanes
that the compiler turns into vector instructions.
"""

import hashlib
import math
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.vehicle.arctangent import arctan2
from fleet_slip.vehicle.compiling import equation, kernel
from fleet_slip.vehicle.driver import (
    SAMPLE_S,
    SPEED_PREVIEW_S,
    STEERING_PREVIEW_S,
    Handling,
    decide,
)
from fleet_slip.vehicle.dynamics import derivative
from fleet_slip.vehicle.integration import SECOND_ORDER, Slopes, advance
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.pose import Path, Pose, PoseSlopes, advance_pose, pose_slopes
from fleet_slip.vehicle.rows import LANES, read, write
from fleet_slip.vehicle.state import Controls, State

AFTER_LOSS = 500
"""Samples that a drive goes on after the driver lost the car: 5 s."""
LOST_OFFSET_M = 10.0
LOST_SLIP_TANGENT = math.sqrt(3.0)
"""Side-slip of 60°."""
LOST_SPEED_MPS = 0.5
NOBODY = -1
"""Drive of a lane that has none, and tick of a loss that has not happened."""

PLAN = np.dtype(
    [
        ("first", np.int64),  # index of the road's first entry in the table of all roads
        ("last", np.int64),
        ("inverse_spacing", np.float64),
        ("length_m", np.float64),
        ("closed", np.bool_),
        ("distance_m", np.float64),
        ("samples", np.int64),  # most that the drive may take
        ("output", np.int64),  # where in the output its channels stand, one after the other
    ]
)
"""What the kernel knows of a drive."""

CURVATURE, SPEED, ACCELERATION = range(3)
"""Columns of the table of all roads: curvature, target speed, target acceleration."""

DRIVE, TICK, LAP = range(3)
"""Rows of the book of lanes: which drive a lane carries, its next sample and its lap."""

SAMPLES, LOST = range(2)
"""Columns of the result: number of samples of a drive, and the tick of its loss or `NOBODY`."""

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
"""Channels of a drive's output, each with room for the samples of its plan."""

STATE = 0
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
ROWS = HANDLING + len(Handling._fields)

STEER = Constants._fields.index("steer_per_wheel")
ACKERMANN = Constants._fields.index("ackermann")


@equation
def _place(plan: Any, station: float) -> tuple[int, float]:
    """Return the entry at or before a station, and how far towards the next the station is.

    A closed road's entries are continued beyond its length by what a driver sees ahead.
    """
    place = station * plan.inverse_spacing
    entry = min(max(math.floor(place), 0), plan.last - plan.first - 1)
    return plan.first + entry, min(max(place - entry, 0.0), 1.0)


@equation
def _look_up(roads: Any, plan: Any, x: State, station: float, lost: bool) -> Path:
    """Return what the driver sees of the road from a station."""
    here, share = _place(plan, station)
    curvature = roads[here, CURVATURE]
    change = roads[here + 1, CURVATURE] - curvature
    ahead, part = _place(plan, station + STEERING_PREVIEW_S * x.vx)
    soon, bit = _place(plan, station + SPEED_PREVIEW_S * x.vx)
    return Path(
        station,
        curvature + share * change,
        change * plan.inverse_spacing,
        (1.0 - part) * roads[ahead, CURVATURE] + part * roads[ahead + 1, CURVATURE],
        (1.0 - bit) * roads[soon, SPEED] + bit * roads[soon + 1, SPEED],
        (1.0 - bit) * roads[soon, ACCELERATION] + bit * roads[soon + 1, ACCELERATION],
        1.0 if lost else 0.0,
    )


@equation
def _clear(memory: Any, lane: int) -> None:
    """Let nothing stand on a lane: a car at rest."""
    for row in range(ROWS):
        memory[row * LANES + lane] = 0.0


@equation
def _begin(memory: Any, lane: int, car: Any, speed: float) -> None:
    """Put a drive on a lane: rolling straight along the line at a speed."""
    _clear(memory, lane)
    for row in range(len(car)):
        memory[(CAR + row) * LANES + lane] = car[row]
    spin = speed * read(memory, CAR, lane, Constants).inverse_radius
    start = State(speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, spin, spin, spin, spin)
    write(memory, STATE, lane, start)
    write(memory, POSE, lane, Pose(0.0, 0.0, 1.0, 0.0))


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
def _integrate(memory: Any, step_s: float, first_step: bool) -> None:
    """Move all cars on by one step; keep the specific force at the first step of a sample."""
    for lane in range(LANES):
        x = read(memory, STATE, lane, State)
        u = read(memory, CONTROLS, lane, Controls)
        c = read(memory, CAR, lane, Constants)
        pose = read(memory, POSE, lane, Pose)
        path = read(memory, PATH, lane, Path)
        order = memory[ORDER * LANES + lane]
        d = derivative(x, u, c)
        slopes_before = read(memory, SLOPES, lane, Slopes)
        after, slopes = advance(x, d, slopes_before, c, step_s, order)
        pose_before = read(memory, POSE_SLOPES, lane, PoseSlopes)
        travel = pose_slopes(x, pose, path)
        ax = d.ax if first_step else memory[FORCE * LANES + lane]
        ay = d.ay if first_step else memory[(FORCE + 1) * LANES + lane]
        write(memory, STATE, lane, after)
        write(memory, SLOPES, lane, slopes)
        write(memory, POSE, lane, advance_pose(pose, travel, pose_before, step_s, order))
        write(memory, POSE_SLOPES, lane, travel)
        write(memory, FORCE, lane, (ax, ay))
        memory[ORDER * LANES + lane] = SECOND_ORDER


@equation
def _has_lost(x: State, pose: Pose) -> bool:
    """Whether the car has left the road, spun or stopped."""
    return (
        abs(pose.offset) > LOST_OFFSET_M
        or abs(x.vy) > LOST_SLIP_TANGENT * x.vx
        or x.vx < LOST_SPEED_MPS
    )


@equation
def _record(truth: Any, plan: Any, tick: int, x: State, pose: Pose) -> None:
    """Write the sample that begins here, but for the specific force, which the next step gives."""
    at = plan.output + tick
    truth[at + 2 * plan.samples] = x.yaw_rate
    truth[at + 3 * plan.samples] = x.steering_wheel
    truth[at + 4 * plan.samples] = x.wheel_fl
    truth[at + 5 * plan.samples] = x.wheel_fr
    truth[at + 6 * plan.samples] = x.wheel_rl
    truth[at + 7 * plan.samples] = x.wheel_rr
    truth[at + 11 * plan.samples] = x.vx
    truth[at + 12 * plan.samples] = x.vy
    truth[at + 13 * plan.samples] = pose.station
    truth[at + 14 * plan.samples] = pose.offset


@equation
def _look(memory: Any, book: Any, plans: Any, roads: Any, truth: Any, ended: Any) -> None:
    """Record where all cars are and look up the road before them."""
    for lane in range(LANES):
        drive, tick = book[DRIVE, lane], book[TICK, lane]
        if drive != NOBODY:
            x = read(memory, STATE, lane, State)
            pose = read(memory, POSE, lane, Pose)
            if ended[drive, LOST] == NOBODY and _has_lost(x, pose):
                ended[drive, LOST] = tick
            _record(truth, plans[drive], tick, x, pose)
            lost = ended[drive, LOST] != NOBODY
            write(memory, PATH, lane, _look_up(roads, plans[drive], x, pose.station, lost))


@equation
def _move_on(memory: Any, book: Any, plans: Any, truth: Any, ended: Any) -> int:
    """Count the sample and the laps of all cars; return the number of drives that end here."""
    finished = 0
    for lane in range(LANES):
        drive, tick = book[DRIVE, lane], book[TICK, lane]
        if drive != NOBODY:
            plan = plans[drive]
            truth[plan.output + tick] = memory[FORCE * LANES + lane]
            truth[plan.output + plan.samples + tick] = memory[(FORCE + 1) * LANES + lane]
            station = memory[POSE * LANES + lane]
            gone = book[LAP, lane] * plan.length_m + station
            if plan.closed:
                lap = 1 if station >= plan.length_m else -1 if station < 0.0 else 0
                book[LAP, lane] += lap
                memory[POSE * LANES + lane] = station - lap * plan.length_m
            book[TICK, lane] = tick + 1
            lost = ended[drive, LOST]
            given_up = lost != NOBODY and tick >= lost + AFTER_LOSS
            if given_up or gone >= plan.distance_m or tick + 1 == plan.samples:
                ended[drive, SAMPLES] = tick + 1
                book[DRIVE, lane] = NOBODY
                finished += 1
    return finished


@equation
def _angles(wheel: Any, left: Any, right: Any, vx: Any, vy: Any, slip: Any, car: Any) -> None:
    """Fill in the road wheels' angles and the side-slip angle of a drive."""
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
def _finish(truth: Any, plans: Any, ended: Any, cars: Any) -> None:
    """Fill in what follows from the recorded."""
    for drive in range(len(plans)):
        size, samples = plans[drive].samples, ended[drive, SAMPLES]
        channels = truth[plans[drive].output :][: len(CHANNELS) * size]
        wheel, left, right = channels[3 * size :], channels[8 * size :], channels[9 * size :]
        slip, vx, vy = channels[10 * size :], channels[11 * size :], channels[12 * size :]
        _angles(wheel[:samples], left, right, vx, vy, slip, cars[drive])


def build_kernel(sources: str) -> Callable[..., NDArray[np.int64]]:
    """Return the kernel, not yet compiled.

    Its closure holds a digest of the `sources`, and so does the key under which numba keeps the
    compiled code on disk: a change of any module compiles it again.
    """

    def simulate(
        plans: Any, cars: Any, roads: Any, queue: Any, steps: int, truth: Any
    ) -> NDArray[np.int64]:
        """Fill `truth`; return the number of samples and the tick of the loss of each drive.

        `plans` are of dtype `PLAN` and point into the table `roads`; `cars` has `Constants` and
        `Handling` in rows; drives get a lane in the order of `queue`; a sample takes `steps` steps.
        """
        _ = sources
        ended = np.full((len(plans), 2), NOBODY)
        memory = np.zeros(ROWS * LANES)
        book = np.full((3, LANES), NOBODY)
        waiting = 0
        running = 0
        while True:
            for lane in range(LANES):
                if book[DRIVE, lane] == NOBODY and waiting < len(queue):
                    drive = queue[waiting]
                    _begin(memory, lane, cars[drive], roads[plans[drive].first, SPEED])
                    book[DRIVE, lane], book[TICK, lane], book[LAP, lane] = drive, 0, 0
                    waiting += 1
                    running += 1
                elif book[DRIVE, lane] == NOBODY:
                    _clear(memory, lane)
            if running == 0:
                _finish(truth, plans, ended, cars)
                return ended
            finished = 0
            while finished == 0:
                _look(memory, book, plans, roads, truth, ended)
                _decide(memory)
                for step in range(steps):
                    _integrate(memory, SAMPLE_S / steps, step == 0)
                finished = _move_on(memory, book, plans, truth, ended)
            running -= finished

    return simulate


def _source_digest() -> str:
    """Return a digest of this package's sources, so that a change of any recompiles the kernel."""
    digest = hashlib.sha256()
    for file in sorted(FilePath(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


simulate = kernel(build_kernel(_source_digest()))
"""The kernel; see `build_kernel`."""
