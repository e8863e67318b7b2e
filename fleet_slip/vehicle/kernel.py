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

import numba
import numpy as np
from numpy.typing import NDArray

from fleet_slip.vehicle.arctangent import arctan2
from fleet_slip.vehicle.compiling import equation
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
        ("first", np.int64),  # index of the road's first entry in the tables
        ("entries", np.int64),
        ("spacing_m", np.float64),
        ("length_m", np.float64),
        ("closed", np.bool_),
        ("distance_m", np.float64),
        ("samples", np.int64),  # most that the drive may take
    ]
)
"""What the kernel knows of a drive."""

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
"""Rows of a drive's output."""

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


@equation
def _between(table: Any, first: int, plan: Any, station: float) -> tuple[float, float]:
    """Return the value of a road's table at a station, and its slope per metre."""
    place = station / plan.spacing_m
    if plan.closed:
        cell = math.floor(place)
        share = place - cell
        here = int(cell) % plan.entries
        there = (here + 1) % plan.entries
    else:
        here = min(max(int(math.floor(place)), 0), plan.entries - 2)
        there = here + 1
        share = min(max(place - here, 0.0), 1.0)
    low, high = table[first + here], table[first + there]
    return low + share * (high - low), (high - low) / plan.spacing_m


@equation
def _look_up(
    curvature: Any, speed: Any, gain: Any, plan: Any, x: State, station: float, lost: bool
) -> Path:
    """Return what the driver sees of the road from a station."""
    first = plan.first
    here, slope = _between(curvature, first, plan, station)
    ahead, _ = _between(curvature, first, plan, station + STEERING_PREVIEW_S * x.vx)
    soon = station + SPEED_PREVIEW_S * x.vx
    target, _ = _between(speed, first, plan, soon)
    rise, _ = _between(gain, first, plan, soon)
    return Path(station, here, slope, ahead, target, rise, 1.0 if lost else 0.0)


@equation
def _begin(memory: Any, lane: int, plan: Any, car: Any, start_speed: float) -> None:
    """Put a drive on a lane: rolling straight along the line at a speed."""
    for row in range(ROWS):
        memory[row * LANES + lane] = 0.0
    for row in range(len(car)):
        memory[(CAR + row) * LANES + lane] = car[row]
    c = read(memory, CAR, lane, Constants)
    spin = start_speed * c.inverse_radius
    write(
        memory,
        STATE,
        lane,
        State(start_speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, spin, spin, spin, spin),
    )
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
def _record(out: Any, tick: int, x: State, pose: Pose) -> None:
    """Write the sample that begins a step; the specific force follows from the step itself."""
    out[2, tick] = x.yaw_rate
    out[3, tick] = x.steering_wheel
    out[4, tick] = x.wheel_fl
    out[5, tick] = x.wheel_fr
    out[6, tick] = x.wheel_rl
    out[7, tick] = x.wheel_rr
    out[11, tick] = x.vx
    out[12, tick] = x.vy
    out[13, tick] = pose.station
    out[14, tick] = pose.offset


@equation
def _finish(out: Any, samples: int, c: Constants) -> None:
    """Fill in what follows from the recorded: the road wheels' angles and the side-slip angle."""
    for tick in range(samples):
        tangent = c.steer_per_wheel * out[3, tick]
        out[8, tick] = arctan2(tangent, 1.0 - c.ackermann * tangent)
        out[9, tick] = arctan2(tangent, 1.0 + c.ackermann * tangent)
        out[10, tick] = arctan2(out[12, tick], out[11, tick])


def _compile(sources: str) -> Callable[..., NDArray[np.int64]]:
    """Compile the kernel. The compiled code is kept on disk for as long as its sources stay."""

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def simulate(
        plans: Any,
        cars: Any,
        curvature: Any,
        speed: Any,
        gain: Any,
        queue: Any,
        steps: int,
        truth: Any,
    ) -> NDArray[np.int64]:
        """Fill `truth` (drives, channels, samples); return the samples and loss tick of each.

        `plans` are of dtype `PLAN`, into the tables of the roads' `curvature`, target `speed` and
        its `gain` in time; `cars` has `Constants` and `Handling` in rows; `queue` is the
        order in which drives get a lane; `steps` is the number of steps per sample.
        """
        _ = sources
        ended = np.full((len(plans), 2), NOBODY)
        memory = np.zeros(ROWS * LANES)
        drive = np.full(LANES, NOBODY)
        tick = np.zeros(LANES, np.int64)
        laps = np.zeros(LANES, np.int64)
        waiting = 0
        running = 0
        while True:
            for lane in range(LANES):
                if drive[lane] == NOBODY and waiting < len(queue):
                    now = queue[waiting]
                    waiting += 1
                    running += 1
                    drive[lane], tick[lane], laps[lane] = now, 0, 0
                    start = speed[plans[now].first]
                    _begin(memory, lane, plans[now], cars[now], start)

            if running == 0:
                return ended
            for lane in range(LANES):
                now = drive[lane]
                if now == NOBODY:
                    continue
                x = read(memory, STATE, lane, State)
                pose = read(memory, POSE, lane, Pose)
                if ended[now, 1] == NOBODY and _has_lost(x, pose):
                    ended[now, 1] = tick[lane]
                _record(truth[now], tick[lane], x, pose)
                lost = ended[now, 1] != NOBODY
                path = _look_up(curvature, speed, gain, plans[now], x, pose.station, lost)
                write(memory, PATH, lane, path)
            _decide(memory)
            for step in range(steps):
                _integrate(memory, SAMPLE_S / steps, step == 0)
            for lane in range(LANES):
                now = drive[lane]
                if now == NOBODY:
                    continue
                plan = plans[now]
                truth[now, 0, tick[lane]] = memory[FORCE * LANES + lane]
                truth[now, 1, tick[lane]] = memory[(FORCE + 1) * LANES + lane]
                tick[lane] += 1
                station = memory[POSE * LANES + lane]
                gone = laps[lane] * plan.length_m + station
                if plan.closed and station >= plan.length_m:
                    laps[lane] += 1
                    memory[POSE * LANES + lane] = station - plan.length_m
                elif plan.closed and station < 0.0:
                    laps[lane] -= 1
                    memory[POSE * LANES + lane] = station + plan.length_m
                over = ended[now, 1] != NOBODY and tick[lane] > ended[now, 1] + AFTER_LOSS
                if over or gone >= plan.distance_m or tick[lane] == plan.samples:
                    ended[now, 0] = tick[lane]
                    _finish(truth[now], tick[lane], read(memory, CAR, lane, Constants))
                    drive[lane] = NOBODY
                    running -= 1
                    for row in range(ROWS):
                        memory[row * LANES + lane] = 0.0

    return simulate  # type: ignore[no-any-return]


def _source_digest() -> str:
    """Return a digest of this package's sources, so that a change of any recompiles the kernel."""
    digest = hashlib.sha256()
    for file in sorted(FilePath(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


simulate = _compile(_source_digest())
"""The kernel; see `_compile`."""
