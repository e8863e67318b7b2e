"""Arctangent from additions, multiplications and one division: the same bits everywhere.

Libraries differ in the last bit. The error is below 1e-12 rad, far under one count.
"""

import math

from fleet_slip.compiling import equation

TAN_PI_8 = math.sqrt(2.0) - 1.0
SMALLEST = 1e-300

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
    """Return the angle of the vector (x, y) in rad, in [−π, π]; 0 for the null vector."""
    small, large = min(abs(x), abs(y)), max(abs(x), abs(y))
    turned = small > TAN_PI_8 * large
    numerator = small - large if turned else small
    denominator = small + large if turned else large
    q = numerator / max(denominator, SMALLEST)
    z = q * q
    series = A0 + z * (A1 + z * (A2 + z * (A3 + z * (A4 + z * (A5 + z * (A6 + z * A7))))))
    octant = q * series + (math.pi / 4 if turned else 0.0)
    quadrant = math.pi / 2 - octant if abs(y) > abs(x) else octant
    half = math.pi - quadrant if x < 0.0 else quadrant
    return -half if y < 0.0 else half
