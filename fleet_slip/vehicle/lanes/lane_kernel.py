"""The compiled loop over time and lanes.

Each lane carries one drive; a lane whose drive has ended takes the next one. At every sample the
scalar part looks up the road and records; the driver's law and the physics are loops over all lanes
that the compiler turns into vector instructions.

When a lane's block of samples is full or its drive ends, the loop stops so that the caller takes
the block; then it is called again.
"""

import hashlib
import math
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any

from fleet_slip import compiling
from fleet_slip.compiling import equation, kernel
from fleet_slip.vehicle.car_imperfections import Traits
from fleet_slip.vehicle.driver import (
    SAMPLE_S,
    SPEED_PREVIEW_S,
    STEERING_PREVIEW_S,
    Handling,
    decide,
)
from fleet_slip.vehicle.dynamics import derivative
from fleet_slip.vehicle.imperfect_dynamics import (
    Around,
    Give,
    GiveRates,
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
from fleet_slip.vehicle.lanes.lane_memory import (
    AROUND,
    BLOCK,
    CAR,
    CONTROLS,
    DRIVE,
    FIRST,
    FORCE,
    GIVE,
    GIVE_SLOPES,
    HANDLING,
    LANES,
    LAP,
    NOBODY,
    ORDER,
    PATH,
    POSE,
    POSE_SLOPES,
    SLOPES,
    STATE,
    TICK,
    TRAITS,
    at,
    fill_angles,
    fill_recorded_angles,
    further_at,
    place,
    read,
    record,
    write,
)
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.state import Controls, State


@equation
def _wheel_tangents(give: Give, c: Constants, t: Traits) -> tuple[float, float]:
    """Return the tangents of the angles of both front wheels."""
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
            warm = read(memory, AROUND, lane, Around).stiffness
            here, share = place(routes[drive], pose.station)
            for column in range(5):
                before, after = surfaces[here, column], surfaces[here + 1, column]
                memory[(AROUND + column) * LANES + lane] = before + share * (after - before)
            memory[(AROUND + 5) * LANES + lane] = 1.0 + (warm - 1.0) * t.cooling
            c = read(memory, CAR, lane, Constants)
            give = read(memory, GIVE, lane, Give)
            left, right = _wheel_tangents(give, c, t)
            sample = book[TICK, lane] - book[FIRST, lane]
            truth[at(lane, 8, sample)] = left
            truth[at(lane, 9, sample)] = right
            truth[further_at(lane, 0, sample)] = read(memory, SLOPES, lane, Slopes).yaw_rate
            truth[further_at(lane, 1, sample)] = x.ax_lag
            truth[further_at(lane, 2, sample)] = x.ay_lag


def build_integrate(imperfect: bool) -> Callable[[Any, float, bool], None]:
    """Compile a step of all cars: of those of the textbook, or of those with imperfections."""

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


def build_kernel(sources: str, imperfect: bool = False) -> Callable[..., None]:
    """Return the kernel, not yet compiled: of cars as in the textbook, or with imperfections.

    Its closure holds a digest of the `sources`, and so does the key under which numba keeps the
    compiled code on disk: a change of any module compiles it again.
    """

    integrate = build_integrate(imperfect)

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
        """Drive on, from sample to sample, until a lane's block is complete.

        `routes` are of dtype `ROUTE` and point into the tables `roads` and, for cars with
        imperfections, `surfaces`; `cars` has `Constants`, `Handling` and `Traits` in rows; a sample
        takes `steps` steps. `truth` is made by `empty_blocks`; `ended` gets the number of samples
        and the tick of the loss of each drive. There must be a drive on some lane.
        """
        _ = sources
        complete = 0
        while complete == 0:
            _look(memory, book, routes, roads, truth, ended)
            if imperfect:
                look_around(memory, book, routes, surfaces, truth)
            _decide(memory)
            for step in range(steps):
                integrate(memory, SAMPLE_S / steps, step == 0)
            complete = _move_on(memory, book, routes, truth, ended)
        _finish(truth, book, ended, cars, imperfect)

    return simulate


def _source_digest() -> str:
    """Return a digest of all sources concerned, so that a change of any recompiles the kernel."""
    digest = hashlib.sha256()
    vehicle = FilePath(__file__).parents[1]
    for file in [*sorted(vehicle.rglob("*.py")), FilePath(compiling.__file__)]:
        digest.update(file.read_bytes())
    return digest.hexdigest()


simulate = kernel(build_kernel(_source_digest()))
"""The kernel; see `build_kernel`."""

simulate_imperfect = kernel(build_kernel(_source_digest(), imperfect=True))
"""The kernel of cars with imperfections."""
