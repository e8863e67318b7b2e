"""One step in time: second order for the car, linearly implicit for its wheels."""

from typing import NamedTuple

from fleet_slip.vehicle.compiling import equation
from fleet_slip.vehicle.dynamics import Derivative
from fleet_slip.vehicle.state import State
from fleet_slip.vehicle.wheels import WheelRate

STEP_S = 0.002
"""Time step of the integration."""

SECOND_ORDER = 0.5
"""Extrapolation of Adams-Bashforth with equal steps; 0 makes the step Euler's, to begin with."""


class Slopes(NamedTuple):
    """Rates of the previous step, of the part of the state that is integrated explicitly."""

    vx: float
    vy: float
    yaw_rate: float
    steering_wheel: float
    traction: float
    ax_lag: float
    ay_lag: float


AT_REST = Slopes(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@equation
def extrapolate(now: float, before: float, extrapolation: float) -> float:
    """Return the slope of an Adams-Bashforth step from this and the previous rate."""
    return now + extrapolation * (now - before)


@equation
def _turned(spin: float, wheel: WheelRate, step: float) -> float:
    """Linearly implicit step of a wheel's speed, as the tyre's stiffness would demand tiny steps.

    Δω (1 + h K) = h (f + h ∂f/∂t), with K = −∂f/∂ω. The last term carries the car's own change of
    speed, so that the wheel follows it without lag however stiff the tyre.
    """
    return spin + step * (wheel.rate + step * wheel.drift) / (1.0 + step * wheel.stiffness)


@equation
def advance(
    x: State, d: Derivative, before: Slopes, step: float, extrapolation: float
) -> tuple[State, Slopes]:
    """Return the state after a step, and the slopes that the next step needs."""
    after = State(
        x.vx + step * extrapolate(d.vx, before.vx, extrapolation),
        x.vy + step * extrapolate(d.vy, before.vy, extrapolation),
        x.yaw_rate + step * extrapolate(d.yaw_rate, before.yaw_rate, extrapolation),
        x.steering_wheel
        + step * extrapolate(d.steering_wheel, before.steering_wheel, extrapolation),
        x.traction + step * extrapolate(d.traction, before.traction, extrapolation),
        x.ax_lag + step * extrapolate(d.ax_lag, before.ax_lag, extrapolation),
        x.ay_lag + step * extrapolate(d.ay_lag, before.ay_lag, extrapolation),
        _turned(x.wheel_fl, d.wheel_fl, step),
        _turned(x.wheel_fr, d.wheel_fr, step),
        _turned(x.wheel_rl, d.wheel_rl, step),
        _turned(x.wheel_rr, d.wheel_rr, step),
    )
    slopes = Slopes(d.vx, d.vy, d.yaw_rate, d.steering_wheel, d.traction, d.ax_lag, d.ay_lag)
    return after, slopes
