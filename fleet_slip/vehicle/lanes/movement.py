"""The physics of the lane kernel: what is around all cars, and how they move on by a step."""

from collections.abc import Callable
from typing import Any

from fleet_slip.compiling import equation
from fleet_slip.vehicle.car_imperfections import Traits
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
    CAR,
    CONTROLS,
    DRIVE,
    FIRST,
    FORCE,
    GIVE,
    GIVE_SLOPES,
    LANES,
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
    further_at,
    place,
    read,
    write,
)
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.state import Controls, State


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
