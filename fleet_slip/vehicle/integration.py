"""One step in time, of second order, with one evaluation of the equations; and the car's pose.

The car is stepped explicitly (Adams-Bashforth; actuators by their Taylor series), its stiff wheels
linearly implicitly (SBDF2; Ascher, Ruuth and Wetton 1995). The pose is curvilinear (Serret-Frenet),
its heading a unit vector: no search, no angle.
"""

from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.dynamics import Derivative, Give, GiveRates, WheelRate
from fleet_slip.vehicle.parameters import Constants, State, Traits

STEP_S = 0.002

FIRST_ORDER = 0.0
"""Extrapolation of the first step: the step is Euler's."""

SECOND_ORDER = 0.5
"""Extrapolation of all other steps, from this and the previous rate."""


class Slopes(NamedTuple):
    """The previous step: rates at its beginning, and how far the wheels' speeds moved."""

    vx: float
    vy: float
    yaw_rate: float
    ax_lag: float
    ay_lag: float
    rate_fl: float
    rate_fr: float
    rate_rl: float
    rate_rr: float
    change_fl: float
    change_fr: float
    change_rl: float
    change_rr: float


@equation
def extrapolate(now: float, before: float, extrapolation: float) -> float:
    """Return the slope of an Adams-Bashforth step from this and the previous rate."""
    return now + extrapolation * (now - before)


@equation
def followed(rate: float, inverse_lag: float, step: float) -> float:
    """Return how far a first-order lag moves in a step under a constant demand, by −rate / lag."""
    return step * rate * (1.0 - 0.5 * step * inverse_lag)


@equation
def turned(
    wheel: WheelRate, rate_before: float, change_before: float, step: float, extrapolation: float
) -> float:
    """Return the change of a wheel's speed in a step, stable however stiff the tyre.

    With K at least −∂f/∂ω, −K ω is taken at the step's end and the rest of the rate extrapolated:
    (3/2 + h K) Δω = Δω_before / 2 + h (2 f − f_before + K Δω_before)
    """
    twice = 2.0 * extrapolation
    rate = wheel.rate + twice * (wheel.rate - rate_before + wheel.stiffness * change_before)
    return (extrapolation * change_before + step * rate) / (
        1.0 + extrapolation + step * wheel.stiffness
    )


@equation
def advance(
    x: State, d: Derivative, before: Slopes, c: Constants, step: float, extrapolation: float
) -> tuple[State, Slopes]:
    """Return the state after a step, and what the next step needs to know of this one."""
    fl = turned(d.wheel_fl, before.rate_fl, before.change_fl, step, extrapolation)
    fr = turned(d.wheel_fr, before.rate_fr, before.change_fr, step, extrapolation)
    rl = turned(d.wheel_rl, before.rate_rl, before.change_rl, step, extrapolation)
    rr = turned(d.wheel_rr, before.rate_rr, before.change_rr, step, extrapolation)
    after = State(
        x.vx + step * extrapolate(d.vx, before.vx, extrapolation),
        x.vy + step * extrapolate(d.vy, before.vy, extrapolation),
        x.yaw_rate + step * extrapolate(d.yaw_rate, before.yaw_rate, extrapolation),
        x.steering_wheel + followed(d.steering_wheel, c.inverse_steering_lag, step),
        x.traction + followed(d.traction, c.inverse_drive_lag, step),
        x.ax_lag + step * extrapolate(d.ax_lag, before.ax_lag, extrapolation),
        x.ay_lag + step * extrapolate(d.ay_lag, before.ay_lag, extrapolation),
        x.wheel_fl + fl,
        x.wheel_fr + fr,
        x.wheel_rl + rl,
        x.wheel_rr + rr,
    )
    slopes = Slopes(
        d.vx,
        d.vy,
        d.yaw_rate,
        d.ax_lag,
        d.ay_lag,
        d.wheel_fl.rate,
        d.wheel_fr.rate,
        d.wheel_rl.rate,
        d.wheel_rr.rate,
        fl,
        fr,
        rl,
        rr,
    )
    return after, slopes


@equation
def advance_give(
    give: Give,
    d: GiveRates,
    before: GiveRates,
    column: float,
    t: Traits,
    step: float,
    extrapolation: float,
) -> Give:
    """Return what follows the car after a step; the rack rests within the play, else goes along."""
    return Give(
        min(max(give.rack, column - t.half_lash), column + t.half_lash),
        give.rack_force + step * extrapolate(d.rack_force, before.rack_force, extrapolation),
        give.side_fl + step * extrapolate(d.side_fl, before.side_fl, extrapolation),
        give.side_fr + step * extrapolate(d.side_fr, before.side_fr, extrapolation),
        give.side_rl + step * extrapolate(d.side_rl, before.side_rl, extrapolation),
        give.side_rr + step * extrapolate(d.side_rr, before.side_rr, extrapolation),
    )


LEAST_RADIUS_SHARE = 0.2
"""The station stops short of the centre of a bend's curvature, where it is not defined."""


class Pose(NamedTuple):
    """Place and heading relative to the road's line."""

    station: float
    """Along the line, in m."""
    offset: float
    """From the line to the left, in m."""
    cosine: float
    """Of the car's heading against the line's."""
    sine: float


class Path(NamedTuple):
    """The road as it was looked up at the last sample."""

    station: float
    curvature: float
    curvature_slope: float
    """Per metre: within a sample curvature is linear in the station."""
    curvature_ahead: float
    target_speed: float
    target_acceleration: float
    lost: float
    """1 once the driver has lost the car, else 0."""


class PoseSlopes(NamedTuple):
    """Rates of the pose."""

    station: float
    offset: float
    cosine: float
    sine: float


@equation
def pose_slopes(x: State, pose: Pose, path: Path) -> PoseSlopes:
    """Return ṡ = (vx cos ψ − vy sin ψ) / (1 − κ e), ė = vx sin ψ + vy cos ψ, and ψ̇ = r − κ ṡ.

    The heading's rate turns its unit vector.
    """
    curvature = path.curvature + path.curvature_slope * (pose.station - path.station)
    shrink = max(1.0 - curvature * pose.offset, LEAST_RADIUS_SHARE)
    station = (x.vx * pose.cosine - x.vy * pose.sine) / shrink
    turning = x.yaw_rate - curvature * station
    return PoseSlopes(
        station, x.vx * pose.sine + x.vy * pose.cosine, -turning * pose.sine, turning * pose.cosine
    )


@equation
def advance_pose(
    pose: Pose, d: PoseSlopes, before: PoseSlopes, step: float, extrapolation: float
) -> Pose:
    """Return the pose after a step of Adams-Bashforth, its unit vector of length 1 again."""
    cosine = pose.cosine + step * extrapolate(d.cosine, before.cosine, extrapolation)
    sine = pose.sine + step * extrapolate(d.sine, before.sine, extrapolation)
    # One Newton iteration for 1/√n from 1: the length is 1 to a few parts in a million before.
    scale = 1.5 - 0.5 * (cosine * cosine + sine * sine)
    return Pose(
        pose.station + step * extrapolate(d.station, before.station, extrapolation),
        pose.offset + step * extrapolate(d.offset, before.offset, extrapolation),
        cosine * scale,
        sine * scale,
    )
