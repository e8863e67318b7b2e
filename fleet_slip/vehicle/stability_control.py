"""Stability control as cars have it: one wheel is braked where the car turns otherwise than asked.

After Rajamani (2012), ch. 8: the reference is the yaw rate of a steady bend, at most what 85 % of
the grip allow. A law of two points: a car that turns too fast is braked at the outer front wheel,
one that turns too slowly at the inner rear wheel (van Zanten 2000).
"""

from fleet_slip.compiling import equation
from fleet_slip.vehicle.car_imperfections import Traits
from fleet_slip.vehicle.driver import SAMPLE_S, Handling
from fleet_slip.vehicle.imperfect_dynamics import Around
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, Constants
from fleet_slip.vehicle.state import State

SLOWEST_MPS = 20 / 3.6
"""Below this speed FMVSS 126 asks for no control."""

GRIP_SHARE = 0.85

BRAKE_LAG_S = 0.1
"""Of the pressure in a brake that no driver has filled."""


@equation
def wanted_yaw_rate(x: State, h: Handling, c: Constants) -> float:
    """Return the yaw rate that the steering wheel asks for: v δ / (L + K v²)."""
    speed = max(x.vx, SLOWEST_MPS)
    asked = speed * c.steer_per_wheel * x.steering_wheel
    rate = asked / (h.wheelbase + max(h.understeer, 0.0) * speed * speed)
    most = GRIP_SHARE * GRAVITY_MPS2 * (c.friction - c.friction_per_load * c.static_front) / speed
    return min(max(rate, -most), most)


@equation
def controlled_brakes(
    x: State, around: Around, h: Handling, c: Constants, t: Traits
) -> tuple[float, float, float, float]:
    """Return the brake forces at fl, fr, rl, rr after a sample."""
    beyond = x.yaw_rate - wanted_yaw_rate(x, h, c)
    force = t.brake if abs(beyond) > t.threshold and x.vx > SLOWEST_MPS else 0.0
    front = force if beyond * x.yaw_rate > 0.0 else 0.0
    left, right = (0.0, 1.0) if beyond > 0.0 else (1.0, 0.0)
    share = SAMPLE_S / BRAKE_LAG_S
    return (
        around.brake_fl + share * (front * left - around.brake_fl),
        around.brake_fr + share * (front * right - around.brake_fr),
        around.brake_rl + share * ((force - front) * left - around.brake_rl),
        around.brake_rr + share * ((force - front) * right - around.brake_rr),
    )
