"""How signals of a drive go with one another: slopes, correlations and fits."""

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray

FEWEST_TICKS = 200
MOVING_MPS = 2.0


def moving(speed: FloatArray | None) -> BoolArray:
    """Return where the car drives; everywhere if its speed is not known."""
    if speed is None:
        return np.ones(1, dtype=np.bool_)
    return np.asarray(np.nan_to_num(speed) > MOVING_MPS)


def slope_of(values: FloatArray, expected: FloatArray, rows: BoolArray) -> tuple[float, float]:
    """Return values over expected, by least squares about their means, and their correlation."""
    rows = rows & np.isfinite(values) & np.isfinite(expected)
    if rows.sum() < FEWEST_TICKS:
        return 1.0, 0.0
    y, x = values[rows] - values[rows].mean(), expected[rows] - expected[rows].mean()
    xx, yy, xy = x @ x, y @ y, x @ y
    if not xx > 0 or not yy > 0:
        return 1.0, 0.0
    return float(xy / xx), float(xy / np.sqrt(xx * yy))


def fit(y: FloatArray, inputs: FloatArray, rows: BoolArray) -> tuple[FloatArray, float]:
    """Return the coefficients of inputs, and the part of the variance of `y` they explain."""
    rows = rows & np.isfinite(y) & np.isfinite(inputs).all(axis=0)
    nothing = np.zeros(len(inputs)), 0.0
    if rows.sum() < FEWEST_TICKS:
        return nothing
    x = inputs[:, rows] - inputs[:, rows].mean(axis=1, keepdims=True)
    centred = y[rows] - y[rows].mean()
    total = float(centred @ centred)
    if not total > 0:
        return nothing
    coefficients = np.linalg.lstsq(x @ x.T, x @ centred, rcond=1e-12)[0]
    left = centred - coefficients @ x
    return coefficients, 1 - float(left @ left) / total
