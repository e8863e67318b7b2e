"""Gaussian state of a Kalman filter, with its time and measurement updates.

Functions change a state in place: a filter takes millions of steps and allocates nothing in them.
"""

from typing import Any, NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation

Row = tuple[Any, ...]
"""A row of a matrix, of a length that the compiler sees: it unrolls the loops over it."""


class GaussianState(NamedTuple):
    """Mean x, shape (n,), covariance P, shape (n, n), and a buffer for F P."""

    mean: FloatArray
    covariance: FloatArray
    buffer: FloatArray


@equation
def independent_state(mean: Row, variances: Row) -> GaussianState:
    """Return a state of independent components."""
    n = len(mean)
    state = GaussianState(np.empty(n), np.zeros((n, n)), np.empty((n, n)))
    for i in range(n):
        state.mean[i] = mean[i]
        state.covariance[i, i] = variances[i]
    return state


@equation
def predict_covariance(state: GaussianState, f: tuple[Row, ...], q: Row) -> None:
    """Update the covariance by one time step, P ← F P Fᵀ + diag(q)."""
    p, fp = state.covariance, state.buffer
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
def measurement_update(state: GaussianState, h: Row, innovation: float, variance: float) -> float:
    """Update by one measurement with the row H, in Joseph's form; return the innovation's variance.

        K = P Hᵀ / (H P Hᵀ + R)
        x ← x + K (z − H x)
        P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    With u = P Hᵀ, P becomes P − K uᵀ + (K R − (u − K H u)) Kᵀ, whose last term is zero but for
    rounding. P (I − K H) alone would lose symmetry and definiteness to it. Measurements with
    independent noises may come one after the other.
    """
    x, p, u = state.mean, state.covariance, state.buffer[0]
    n = len(h)
    predicted = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * h[j]
        u[i] = total
        predicted += h[i] * total
    for i in range(n):
        gain = u[i] / (predicted + variance)
        residual = gain * variance - (u[i] - gain * predicted)
        x[i] += gain * innovation
        for j in range(i, n):
            p[i, j] = p[i, j] - gain * u[j] + residual * (u[j] / (predicted + variance))
            p[j, i] = p[i, j]
    return predicted + variance
