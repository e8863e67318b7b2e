"""Distribution functions: normal, Student's t, F and chi-square, instead of all of SciPy."""

import math

import numpy as np

from fleet_slip.arrays import FloatArray

_TINY = 1e-300
_erfc = np.vectorize(math.erfc, otypes=[np.float64])


def normal_density(x: FloatArray | float) -> FloatArray:
    """Return the density of the standard normal distribution."""
    return np.asarray(np.exp(-0.5 * np.square(x)) / math.sqrt(2 * math.pi), dtype=np.float64)


def normal_cdf(x: FloatArray | float) -> FloatArray:
    """Return the distribution function of the standard normal distribution."""
    return np.asarray(0.5 * _erfc(-np.asarray(x) / math.sqrt(2)), dtype=np.float64)


def student_t_two_sided(t: float, degrees: float) -> float:
    """Return P(|T| >= |t|) for Student's t distribution."""
    if math.isinf(t):
        return 0.0
    return incomplete_beta(degrees / 2, 0.5, degrees / (degrees + t * t))


def student_t_quantile(p: float, degrees: float) -> float:
    """Return the t exceeded with probability 1 - p, p > 1/2, by bisection to adjacent numbers."""
    low, high = 0.0, 1.0
    while student_t_two_sided(high, degrees) > 2 * (1 - p):
        high *= 2
    while low < (middle := (low + high) / 2) < high:
        if student_t_two_sided(middle, degrees) > 2 * (1 - p):
            low = middle
        else:
            high = middle
    return high


def f_upper(f: float, numerator: float, denominator: float) -> float:
    """Return P(F >= f) for the F distribution with the given degrees of freedom."""
    if f <= 0:
        return 1.0
    x = denominator / (denominator + numerator * f)
    return incomplete_beta(denominator / 2, numerator / 2, x)


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Return I_x(a, b), by Lentz's method on Abramowitz and Stegun 26.5.8."""
    if x <= 0:
        return 0.0
    if x >= 1:
        return 1.0
    if x > (a + 1) / (a + b + 2):
        return 1 - incomplete_beta(b, a, 1 - x)
    log_front = (
        math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    )
    return math.exp(log_front) * _beta_fraction(a, b, x) / a


def _beta_fraction(a: float, b: float, x: float) -> float:
    c, d = 1.0, 1 / _away_from_zero(1 - (a + b) * x / (a + 1))
    result = d
    for m in range(1, 100_000):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            d = 1 / _away_from_zero(1 + term * d)
            c = _away_from_zero(1 + term / c)
            result *= c * d
        if abs(c * d - 1) < 1e-15:
            break
    return result


def _away_from_zero(value: float) -> float:
    return value if abs(value) > _TINY else _TINY
