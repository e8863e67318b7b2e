"""Schemes of integration, each a step of the package's own equations of motion."""

from fleet_slip.compiling import equation
from fleet_slip.vehicle.dynamics import Derivative, derivative
from fleet_slip.vehicle.integration import FIRST_ORDER, Slopes, advance
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.state import Controls, State


@equation
def moved(x: State, d: Derivative, step: float) -> State:
    """Return the state after a step along constant rates."""
    return State(
        x.vx + step * d.vx,
        x.vy + step * d.vy,
        x.yaw_rate + step * d.yaw_rate,
        x.steering_wheel + step * d.steering_wheel,
        x.traction + step * d.traction,
        x.ax_lag + step * d.ax_lag,
        x.ay_lag + step * d.ay_lag,
        x.wheel_fl + step * d.wheel_fl.rate,
        x.wheel_fr + step * d.wheel_fr.rate,
        x.wheel_rl + step * d.wheel_rl.rate,
        x.wheel_rr + step * d.wheel_rr.rate,
    )


@equation
def with_wheels(x: State, other: State) -> State:
    """Return a state with the wheel speeds of another one."""
    return State(
        x.vx,
        x.vy,
        x.yaw_rate,
        x.steering_wheel,
        x.traction,
        x.ax_lag,
        x.ay_lag,
        other.wheel_fl,
        other.wheel_fr,
        other.wheel_rl,
        other.wheel_rr,
    )


@equation
def explicit_euler(
    x: State, u: Controls, c: Constants, before: Slopes, step: float, _order: float
) -> tuple[State, Slopes]:
    """All explicit, first order."""
    return moved(x, derivative(x, u, c), step), before


@equation
def linearly_implicit_euler(
    x: State, u: Controls, c: Constants, before: Slopes, step: float, _order: float
) -> tuple[State, Slopes]:
    """Wheels linearly implicit, the rest explicit, first order: the default's first step."""
    return advance(x, derivative(x, u, c), before, c, step, FIRST_ORDER)


@equation
def semi_implicit_euler(
    x: State, u: Controls, c: Constants, before: Slopes, step: float, _order: float
) -> tuple[State, Slopes]:
    """Wheels linearly implicit, then the body under the forces of the new wheel speeds."""
    after, slopes = advance(x, derivative(x, u, c), before, c, step, FIRST_ORDER)
    body = moved(x, derivative(with_wheels(x, after), u, c), step)
    return with_wheels(body, after), slopes


@equation
def heun(
    x: State, u: Controls, c: Constants, before: Slopes, step: float, _order: float
) -> tuple[State, Slopes]:
    """Explicit Runge-Kutta of second order."""
    first = derivative(x, u, c)
    second = derivative(moved(x, first, step), u, c)
    return moved(moved(x, first, step / 2.0), second, step / 2.0), before


@equation
def runge_kutta_4(
    x: State, u: Controls, c: Constants, before: Slopes, step: float, _order: float
) -> tuple[State, Slopes]:
    """Explicit Runge-Kutta of fourth order: highway-env's scheme."""
    first = derivative(x, u, c)
    second = derivative(moved(x, first, step / 2.0), u, c)
    third = derivative(moved(x, second, step / 2.0), u, c)
    fourth = derivative(moved(x, third, step), u, c)
    x = moved(moved(x, first, step / 6.0), second, step / 3.0)
    return moved(moved(x, third, step / 3.0), fourth, step / 6.0), before


@equation
def default(
    x: State, u: Controls, c: Constants, before: Slopes, step: float, order: float
) -> tuple[State, Slopes]:
    """Body by Adams-Bashforth, wheels by SBDF2, one evaluation a step: the simulator's scheme."""
    return advance(x, derivative(x, u, c), before, c, step, order)


SCHEMES = {
    "explicit Euler": explicit_euler,
    "linearly implicit Euler": linearly_implicit_euler,
    "semi-implicit Euler": semi_implicit_euler,
    "Heun": heun,
    "Runge-Kutta 4": runge_kutta_4,
    "Adams-Bashforth with SBDF2 (default)": default,
}
