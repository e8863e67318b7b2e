"""Long noisy series with few points: what they do on average, and how far they scatter."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray


@dataclass(frozen=True)
class Band:
    """A series in bins of equal length; all arrays have shape (bins,).

    Attributes:
        x: middle of each bin.
        mean: mean of the bin's values; NaN where there is none.
        low, high: its smallest and its largest value.
    """

    x: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray


def band(x: FloatArray, y: FloatArray, bins: int) -> Band:
    """Cut a series, shape (rows,), into at most so many bins. NaN stands for no value."""
    size = max(1, -(-len(x) // bins))
    count = -(-len(x) // size)
    padded = np.full((2, count * size), np.nan)
    padded[:, : len(x)] = x, y
    xs, ys = padded.reshape(2, count, size)
    finite = np.isfinite(ys)
    none = ~finite.any(axis=1)
    rows = np.maximum(finite.sum(axis=1), 1)
    mean = np.where(finite, ys, 0.0).sum(axis=1) / rows
    low = np.where(finite, ys, np.inf).min(axis=1)
    high = np.where(finite, ys, -np.inf).max(axis=1)
    middle = np.nansum(xs, axis=1) / np.isfinite(xs).sum(axis=1)
    return Band(middle, *(np.where(none, np.nan, values) for values in (mean, low, high)))


def smooth(values: FloatArray, samples: int) -> FloatArray:
    """Return the mean over a window around each sample, shorter at both ends; shape (rows,)."""
    window = np.ones(samples)
    count = np.convolve(np.ones(len(values)), window, mode="same")
    mean: FloatArray = np.convolve(values, window, mode="same") / count
    return mean
