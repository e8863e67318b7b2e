"""Time integration of second order, with one evaluation of the equations a step; the car's pose.

Body and load transfer use explicit Adams-Bashforth steps, actuators their Taylor series. The stiff
wheels use linearly implicit steps (SBDF2). The pose is curvilinear (Serret-Frenet) and its heading
a unit vector, so that no nearest point is searched and no angle is computed.

References
----------
U. M. Ascher, S. J. Ruuth, B. T. R. Wetton, "Implicit-explicit methods for time-dependent partial
differential equations", SIAM J. Numer. Anal. 32 (1995).
"""

from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.dynamics import (
    Compliance,
    ComplianceRates,
    Derivative,
    Environment,
    WheelRate,
    imperfect_derivative,
)
from fleet_slip.vehicle.parameters import Constants, Controls, ImperfectionConstants, State

STEP_S = 0.002
"""Time step in s. `docs/simulator.md` compares the errors of other steps."""

FIRST_ORDER = 0.0
"""Weight of the extrapolation in a drive's first step: the explicit Euler method."""

SECOND_ORDER = 0.5
"""Weight of the extrapolation in all other steps, from the present and the previous rate."""


class Slopes(NamedTuple):
    """Rates at the beginning of the previous step, and the changes of the wheels' speeds in it."""

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
def extrapolate(rate: float, previous: float, extrapolation: float) -> float:
    """Compute the slope of an Adams-Bashforth step from the present and the previous rate."""
    return rate + extrapolation * (rate - previous)


@equation
def lag_step(rate: float, inverse_lag: float, step: float) -> float:
    """Compute the change of a first-order lag in a step under a constant demand.

    h ẏ (1 − h / (2 τ)), the Taylor series of τ ẏ (1 − exp(−h / τ)) to second order.

    Parameters
    ----------
    rate
        Rate ẏ at the beginning of the step.
    inverse_lag
        1 / τ, in 1/s.
    step
        Time step h, in s.
    """
    return step * rate * (1.0 - 0.5 * step * inverse_lag)


@equation
def wheel_step(
    wheel: WheelRate, previous_rate: float, previous_change: float, step: float, order: float
) -> float:
    """Compute the change of a wheel's speed in a step, stable for any stiffness of the tyre.

    With K at least −∂f/∂ω, the term −K ω is implicit and the remaining rate is extrapolated::

        (3/2 + h K) Δω = Δω_previous / 2 + h (2 f − f_previous + K Δω_previous)

    Parameters
    ----------
    wheel
        Rate f and stiffness K of the wheel.
    previous_rate, previous_change
        Rate at the beginning of the previous step in rad/s², and the change in it in rad/s.
    step
        Time step h, in s.
    order
        `FIRST_ORDER` in a drive's first step, else `SECOND_ORDER`.

    Returns
    -------
    float
        Change Δω of the wheel's speed, in rad/s.
    """
    twice = 2.0 * order
    rate = wheel.rate + twice * (wheel.rate - previous_rate + wheel.stiffness * previous_change)
    return (order * previous_change + step * rate) / (1.0 + order + step * wheel.stiffness)


@equation
def advance(
    x: State, d: Derivative, previous: Slopes, c: Constants, step: float, order: float
) -> tuple[State, Slopes]:
    """Advance the state by one step.

    Parameters
    ----------
    x, d
        State and its rates at the beginning of the step.
    previous
        Slopes of the previous step; zeros in a drive's first step.
    c
        Constants of the car.
    step
        Time step, in s.
    order
        `FIRST_ORDER` in a drive's first step, else `SECOND_ORDER`.

    Returns
    -------
    State
        State at the end of the step.
    Slopes
        Slopes for the next step.
    """
    fl = wheel_step(d.wheel_fl, previous.rate_fl, previous.change_fl, step, order)
    fr = wheel_step(d.wheel_fr, previous.rate_fr, previous.change_fr, step, order)
    rl = wheel_step(d.wheel_rl, previous.rate_rl, previous.change_rl, step, order)
    rr = wheel_step(d.wheel_rr, previous.rate_rr, previous.change_rr, step, order)
    after = State(
        x.vx + step * extrapolate(d.vx, previous.vx, order),
        x.vy + step * extrapolate(d.vy, previous.vy, order),
        x.yaw_rate + step * extrapolate(d.yaw_rate, previous.yaw_rate, order),
        x.steering_wheel + lag_step(d.steering_wheel, c.inverse_steering_lag, step),
        x.traction + lag_step(d.traction, c.inverse_drive_lag, step),
        x.ax_lag + step * extrapolate(d.ax_lag, previous.ax_lag, order),
        x.ay_lag + step * extrapolate(d.ay_lag, previous.ay_lag, order),
        x.wheel_fl + fl,
        x.wheel_fr + fr,
        x.wheel_rl + rl,
        x.wheel_rr + rr,
    )
    f_fl, f_fr, f_rl, f_rr = d.wheel_fl.rate, d.wheel_fr.rate, d.wheel_rl.rate, d.wheel_rr.rate
    return after, Slopes(
        d.vx, d.vy, d.yaw_rate, d.ax_lag, d.ay_lag, f_fl, f_fr, f_rl, f_rr, fl, fr, rl, rr
    )


@equation
def advance_compliance(
    compliance: Compliance,
    d: ComplianceRates,
    previous: ComplianceRates,
    column: float,
    t: ImperfectionConstants,
    step: float,
    order: float,
) -> Compliance:
    """Advance the elastic states by one step.

    Parameters
    ----------
    compliance, d
        Elastic states and their rates at the beginning of the step.
    previous
        Rates of the previous step.
    column
        Angle of the steering wheel at the end of the step, in rad. The rack rests within the play
        about it, and is carried along at its ends.
    t
        Constants of the car's imperfections.
    step, order
        As of `advance`.

    Returns
    -------
    Compliance
        Elastic states at the end of the step.
    """
    return Compliance(
        min(max(compliance.rack, column - t.half_lash), column + t.half_lash),
        compliance.rack_force + step * extrapolate(d.rack_force, previous.rack_force, order),
        compliance.side_fl + step * extrapolate(d.side_fl, previous.side_fl, order),
        compliance.side_fr + step * extrapolate(d.side_fr, previous.side_fr, order),
        compliance.side_rl + step * extrapolate(d.side_rl, previous.side_rl, order),
        compliance.side_rr + step * extrapolate(d.side_rr, previous.side_rr, order),
    )


MIN_RADIUS_RATIO = 0.2
"""Lower bound of 1 − κ e: at the centre of a bend's curvature the station is not defined."""


class Pose(NamedTuple):
    """Position and heading relative to the road's line."""

    station: float
    """Along the line, in m."""
    offset: float
    """From the line to the left, in m."""
    cosine: float
    """Cosine of the car's heading against the line's."""
    sine: float


class Path(NamedTuple):
    """The road as the driver sees it at a sample."""

    station: float
    curvature: float
    curvature_slope: float
    """Change of curvature per metre: within a sample curvature is linear in the station."""
    curvature_ahead: float
    target_speed: float
    target_acceleration: float
    lost: float
    """1 after the driver lost the car, else 0."""


class PoseSlopes(NamedTuple):
    """Rates of the pose."""

    station: float
    offset: float
    cosine: float
    sine: float


@equation
def pose_slopes(x: State, pose: Pose, path: Path) -> PoseSlopes:
    """Compute the rates of the pose on a line of curvature κ.

    With station s, offset e and heading ψ against the line::

        ṡ = (vx cos ψ − vy sin ψ) / (1 − κ e)
        ė = vx sin ψ + vy cos ψ
        ψ̇ = r − κ ṡ, which rotates the unit vector of the heading

    Parameters
    ----------
    x
        State of the car.
    pose
        Position and heading.
    path
        Curvature of the line.

    Returns
    -------
    PoseSlopes
        Rates of station and offset in m/s, and of the unit vector in 1/s.
    """
    curvature = path.curvature + path.curvature_slope * (pose.station - path.station)
    shrink = max(1.0 - curvature * pose.offset, MIN_RADIUS_RATIO)
    station = (x.vx * pose.cosine - x.vy * pose.sine) / shrink
    turning = x.yaw_rate - curvature * station
    return PoseSlopes(
        station, x.vx * pose.sine + x.vy * pose.cosine, -turning * pose.sine, turning * pose.cosine
    )


@equation
def advance_pose(
    pose: Pose, d: PoseSlopes, previous: PoseSlopes, step: float, order: float
) -> Pose:
    """Advance the pose by an Adams-Bashforth step, and normalise the unit vector of the heading.

    Parameters and result are as those of `advance`.
    """
    cosine = pose.cosine + step * extrapolate(d.cosine, previous.cosine, order)
    sine = pose.sine + step * extrapolate(d.sine, previous.sine, order)
    # One Newton iteration for 1/√n from 1: the length is 1 to a few parts in a million before.
    scale = 1.5 - 0.5 * (cosine * cosine + sine * sine)
    return Pose(
        pose.station + step * extrapolate(d.station, previous.station, order),
        pose.offset + step * extrapolate(d.offset, previous.offset, order),
        cosine * scale,
        sine * scale,
    )


class Motion(NamedTuple):
    """State and pose of a car, and their rates in the previous step."""

    state: State
    compliance: Compliance
    pose: Pose
    slopes: Slopes
    compliance_rates: ComplianceRates
    pose_slopes: PoseSlopes


@equation
def advance_car(
    motion: Motion,
    u: Controls,
    path: Path,
    environment: Environment,
    c: Constants,
    t: ImperfectionConstants,
    step: float,
    order: float,
) -> tuple[Motion, float, float]:
    """Advance a car by one step: the equations of motion, and their integration.

    Parameters
    ----------
    motion
        Motion at the beginning of the step.
    u, path, environment
        Demands of the driver, curvature of the line, and road and air.
    c, t
        Constants of the car and of its imperfections.
    step, order
        As of `advance`.

    Returns
    -------
    Motion
        Motion at the end of the step.
    float, float
        Specific force ax and ay at the beginning of the step, in m/s².
    """
    x = motion.state
    d, rates = imperfect_derivative(x, u, motion.compliance, environment, c, t)
    state, slopes = advance(x, d, motion.slopes, c, step, order)
    compliance = advance_compliance(
        motion.compliance, rates, motion.compliance_rates, state.steering_wheel, t, step, order
    )
    travel = pose_slopes(x, motion.pose, path)
    pose = advance_pose(motion.pose, travel, motion.pose_slopes, step, order)
    return Motion(state, compliance, pose, slopes, rates, travel), d.ax, d.ay
