"""The compiled loop over time and lanes, each of which carries one drive after the other.

At every sample the scalar part looks up the road and records; driver and physics are loops over all
lanes, vector instructions. When a block is full or its drive ends, the caller takes it.
"""

import math
from collections.abc import Callable
from typing import Any

from fleet_slip.compiling import equation, kernel
from fleet_slip.vehicle.driver import (
    SAMPLE_S,
    SPEED_PREVIEW_S,
    STEERING_PREVIEW_S,
    Handling,
    decide,
)
from fleet_slip.vehicle.integration import (
    Path,
    Pose,
)
from fleet_slip.vehicle.lanes.lane_memory import (
    BLOCK,
    CAR,
    CONTROLS,
    DRIVE,
    FIRST,
    FORCE,
    HANDLING,
    LANES,
    LAP,
    NOBODY,
    PATH,
    POSE,
    STATE,
    TICK,
    at,
    fill_angles,
    fill_recorded_angles,
    integrate,
    integrate_imperfect,
    look_around,
    place,
    read,
    record,
    write,
)
from fleet_slip.vehicle.parameters import Constants, Controls, State

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
