"""Non-negative least squares (Lawson and Hanson 1974, Solving Least Squares Problems, ch. 23)."""

import numpy as np

from fleet_slip.arrays import FloatArray


def nonnegative_least_squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return x >= 0 that minimises |a x - b|, for a of shape (rows, columns)."""
    columns = a.shape[1]
    x = np.zeros(columns)
    passive = np.zeros(columns, dtype=bool)
    tolerance = 10 * np.finfo(float).eps * max(a.shape) * float(np.abs(a).sum(axis=0).max())
    for _ in range(3 * columns + 10):
        gradient = np.where(passive, -np.inf, a.T @ (b - a @ x))
        entering = int(np.argmax(gradient))
        if gradient[entering] <= tolerance:
            break
        passive[entering] = True
        x = _settle(a, b, x, passive)
    return x


def _settle(
    a: FloatArray, b: FloatArray, x: FloatArray, passive: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> FloatArray:
    """Solve for the passive variables, moving those that would go negative back to zero."""
    while passive.any():
        trial = np.zeros_like(x)
        trial[passive] = np.linalg.lstsq(a[:, passive], b, rcond=None)[0]
        negative = passive & (trial <= 0)
        if not negative.any():
            return trial
        step = float(np.min(x[negative] / (x[negative] - trial[negative])))
        x = x + step * (trial - x)
        passive &= x > 1e-15
        x = np.where(passive, x, 0.0)
    return np.zeros_like(x)
