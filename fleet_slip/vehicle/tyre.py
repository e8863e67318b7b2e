"""The brush tyre model with combined slip, and a portable arctangent.

Bristles stick to the road over a part of the contact patch and slide over the remainder. The model
and its derivation are in `docs/vehicle.md`.

References
----------
H. B. Pacejka, "Tire and Vehicle Dynamics", 3rd ed. (2012), section 3.3, equations 4.E25
(cornering stiffness over load) and 4.E7 (friction over sliding speed).
J. Svendenius, "Tire Modeling and Friction Estimation" (Lund, 2007): sticking and sliding parts.
"""

import math
from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.parameters import Constants

CREEP_SPEED_MPS = 2.5
"""Lower bound of the rolling speed that slip is divided by, in m/s, so that a car comes to rest.

Stable where C h / (m v) < 1/4, with C the slip stiffness of all wheels, h the time step, m the
mass and v this speed. `MAX_STIFFNESS_PER_LOAD` limits C.
"""

MIN_SLIDING_MPS = 1e-9
"""Lower bound of the sliding speed in m/s: the direction of sliding stays finite at rest."""


class TyreForce(NamedTuple):
    """Force of the road on the tyre in the wheel's frame."""

    x: float
    """Along the wheel, in N."""
    y: float
    """Across the wheel to the left, in N."""
    damping: float
    """Approximately −∂x/∂(longitudinal velocity), in N s/m: how the tyre damps the wheel's spin."""
    slip: float
    """Longitudinal slip σx, positive when driven."""
    slip_per_speed: float
    """∂σx/∂(rolling speed), in s/m."""


@equation
def cornering_stiffness(load: float, peak: float, c: Constants) -> float:
    """Compute the cornering stiffness c1·sin(2·arctan(Fz/c2)), without the sine.

    Parameters
    ----------
    load
        Vertical load Fz, in N.
    peak
        Largest cornering stiffness c1, in N per unit of slip.
    c
        Constants of the car.

    Returns
    -------
    float
        Cornering stiffness, in N per unit of slip.

    References
    ----------
    Pacejka (2012), equation 4.E25.
    """
    x = load * c.inverse_stiffness_load
    return peak * 2.0 * x / (1.0 + x * x)


@equation
def brush_force(
    along: float,
    across: float,
    rolling: float,
    load: float,
    peak: float,
    c: Constants,
    grip: float = 1.0,
) -> TyreForce:
    """Compute the force of a brush tyre.

    With slip stiffnesses Cx and Cy, slip σ = v_s / |rolling| and μ(v_s) = μ0 / (1 + |v_s| / V),
    bristles stick over a part λ of the contact patch::

        λ = max(0, 1 − |(Cx σx, Cy σy)| / (3 μ0 Fz))
        F = λ² (Cx σx, Cy σy) + (1 − λ)² (1 + 2 λ) μ(v_s) Fz v_s / |v_s|, v_s against the sliding.

    Parameters
    ----------
    along, across
        Velocity of the wheel's centre in the wheel's frame, in m/s.
    rolling
        Spin times rolling radius, in m/s.
    load
        Vertical load, positive, in N.
    peak
        Largest cornering stiffness, in N per unit of slip.
    c
        Constants of the car.
    grip
        Adhesion at this wheel over the adhesion of the drive.

    Returns
    -------
    TyreForce
        Force of the road on the tyre.
    """
    slide_x = rolling - along
    slide_y = -across
    limit = (c.friction - c.friction_per_load * load) * load * grip
    # One division serves three quotients: 1 / speed, Cy = 2 c1 x / (1 + x²), and 1 / (3 limit).
    speed = max(abs(rolling), CREEP_SPEED_MPS)
    x = load * c.inverse_stiffness_load
    steep = 1.0 + x * x
    triple = 3.0 * limit
    inverse = 1.0 / (speed * steep * triple)
    per_speed = inverse * steep * triple
    bristle_y = inverse * triple * peak * 2.0 * x
    bristle_x = c.stiffness_ratio * bristle_y
    stuck_x = bristle_x * slide_x
    stuck_y = bristle_y * slide_y
    used = math.sqrt(stuck_x * stuck_x + stuck_y * stuck_y) * (inverse * steep * speed)
    stuck = max(0.0, 1.0 - used)
    stuck2 = stuck * stuck
    loose = (1.0 - stuck) * (1.0 - stuck) * (1.0 + 2.0 * stuck)
    sliding = max(math.sqrt(slide_x * slide_x + slide_y * slide_y), MIN_SLIDING_MPS)
    decay = 1.0 + sliding * c.inverse_decay_speed
    decayed = 1.0 / (sliding * decay)
    drag = limit * loose * decayed
    direction_y = slide_y * decayed * decay
    return TyreForce(
        stuck2 * stuck_x + drag * slide_x,
        stuck2 * stuck_y + drag * slide_y,
        stuck2 * bristle_x + drag * direction_y * direction_y,
        slide_x * per_speed,
        per_speed,
    )


TAN_PI_8 = math.sqrt(2.0) - 1.0
MIN_DENOMINATOR = 1e-300
"""Keeps the quotient of the null vector finite."""

A0 = 0.99999999999927092
A1 = -0.3333333327838281
A2 = 0.19999993188756549
A3 = -0.14285391255132365
A4 = 0.11103534845215567
A5 = -0.089932166610089848
A6 = 0.069770025182929116
A7 = -0.037701690770728893
"""Near-minimax fit of arctan(q)/q over q², |q| ≤ tan(π/8), at Chebyshev nodes; error 3e-13."""


@equation
def arctan2(y: float, x: float) -> float:
    """Compute the angle of a vector, with the same bits on every machine.

    C libraries differ in the last bit of `atan2`. This one uses additions, multiplications and one
    division. Its error is below 1e-12 rad, far less than one count.

    Parameters
    ----------
    y, x
        Components of the vector.

    Returns
    -------
    float
        Angle in rad, in [−π, π]; 0 for the null vector.
    """
    small, large = min(abs(x), abs(y)), max(abs(x), abs(y))
    rotated = small > TAN_PI_8 * large
    numerator = small - large if rotated else small
    denominator = small + large if rotated else large
    q = numerator / max(denominator, MIN_DENOMINATOR)
    z = q * q
    series = A0 + z * (A1 + z * (A2 + z * (A3 + z * (A4 + z * (A5 + z * (A6 + z * A7))))))
    octant = q * series + (math.pi / 4 if rotated else 0.0)
    quadrant = math.pi / 2 - octant if abs(y) > abs(x) else octant
    half = math.pi - quadrant if x < 0.0 else quadrant
    return -half if y < 0.0 else half
