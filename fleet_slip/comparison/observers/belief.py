"""What a Kalman filter believes of its state, and the algebra that all filters here share.

Functions change a belief in place: a filter takes millions of steps, and allocates nothing in them.
"""

from typing import Any, NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation

Row = tuple[Any, ...]
"""A row of a matrix, of a length that the compiler knows: it unrolls the loops over it."""


class Belief(NamedTuple):
    """Mean x of a state, shape (n,), its covariance P, shape (n, n), and room for F P."""

    mean: FloatArray
    covariance: FloatArray
    room: FloatArray


@equation
def belief_of(mean: Row, variances: Row) -> Belief:
    """Return a belief whose states are independent of one another."""
    n = len(mean)
    belief = Belief(np.empty(n), np.zeros((n, n)), np.empty((n, n)))
    for i in range(n):
        belief.mean[i] = mean[i]
        belief.covariance[i, i] = variances[i]
    return belief


@equation
def spread(belief: Belief, f: tuple[Row, ...], q: Row) -> None:
    """Carry the covariance one step on, P ← F P Fᵀ + diag(q)."""
    p, fp = belief.covariance, belief.room
    n = len(q)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += f[i][k] * p[k, j]
            fp[i, j] = total
    for i in range(n):
        for j in range(i, n):
            total = 0.0
            for k in range(n):
                total += fp[i, k] * f[j][k]
            p[i, j] = total
            p[j, i] = total
        p[i, i] += q[i]


@equation
def condition(belief: Belief, h: Row, innovation: float, variance: float) -> float:
    """Take in one measurement with the row H, in Joseph's form; return the innovation's variance.

        K = P Hᵀ / (H P Hᵀ + R)
        x ← x + K (z − H x)
        P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    With u = P Hᵀ, P becomes P − K uᵀ + (K R − (u − K H u)) Kᵀ, whose last term is zero but for
    rounding. P (I − K H) alone would lose symmetry and definiteness to it. Measurements with
    independent noises may come one after the other.
    """
    x, p, u = belief.mean, belief.covariance, belief.room[0]
    n = len(h)
    known = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * h[j]
        u[i] = total
        known += h[i] * total
    for i in range(n):
        gain = u[i] / (known + variance)
        rest = gain * variance - (u[i] - gain * known)
        x[i] += gain * innovation
        for j in range(i, n):
            p[i, j] = p[i, j] - gain * u[j] + rest * (u[j] / (known + variance))
            p[j, i] = p[i, j]
    return known + variance
