"""The signals of a drive on a regular grid of ticks, fits among them, and moments of drives."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import SATELLITE_SPEED
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog

if TYPE_CHECKING:
    from fleet_slip.regression.gram import GramTable

Signals: TypeAlias = Mapping[str, FloatArray]
"""Values in SI units on consecutive ticks, NaN for missing values; all of shape (n_ticks,)."""

TICKS_PER_S = round(1 / float(SAMPLE_TIME_S))
MIN_TICKS = 200
"""Fewest ticks of a fit: 2 s."""
MIN_CORRELATION = 0.6
"""Minimum correlation to compare the sizes of two signals; 0.9 in a sound drive on bends."""
MOVING_MPS = 2.0
"""Minimum speed: below it sensors measure no angle, and receivers freeze the course."""
RADIUS_M, TRACK_M = 0.31, 1.55
"""Rolling radius and track width of a passenger car."""
WHEELS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
SIGNED = ("ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr")
"""Positive in a left turn."""
OWN_SPEEDS = ("vx", "vehicle_speed")
SPEEDS_OF_CAR = (*OWN_SPEEDS, SATELLITE_SPEED)
SPEEDS = (*OWN_SPEEDS, *WHEELS)
"""Signals that `is_slow` reads."""


def to_regular_grid(
    catalog: SignalCatalog, ticks: NDArray[np.int32], counts: Mapping[str, FloatArray]
) -> Signals:
    """Return counts at some ticks in SI units on all ticks from the first, NaN for missing ones."""
    signals = {}
    for name, values in counts.items():
        signals[name] = np.full(int(ticks[-1] - ticks[0]) + 1, np.nan)
        signals[name][ticks - ticks[0]] = values * float(catalog[name].scale)
    return signals


def wheel_speed_mps(signals: Signals) -> FloatArray | None:
    """Return the median speed of the wheels; None without wheels."""
    wheels = [signals[name] for name in WHEELS if name in signals]
    if not wheels:
        return None
    return np.asarray(np.median(wheels, axis=0) * RADIUS_M, dtype=np.float64)


def speed_mps(signals: Signals) -> FloatArray:
    """Return a rough speed: that of the wheels, else `vx` or the car's own; NaN without any."""
    wheels = wheel_speed_mps(signals)
    if wheels is not None:
        return wheels
    return signals.get("vx", signals.get("vehicle_speed", np.full(1, np.nan)))


def is_moving(signals: Signals) -> BoolArray:
    """Return a mask of rows with any speed above `MOVING_MPS`; all rows without a speed.

    Any speed is sufficient, since another one may have a wrong unit.
    """
    speeds = [signals[name] for name in SPEEDS_OF_CAR if name in signals]
    wheels = wheel_speed_mps(signals)
    speeds += [] if wheels is None else [wheels]
    if not speeds:
        return np.ones(1, dtype=np.bool_)
    return np.asarray(np.any([np.nan_to_num(speed) > MOVING_MPS for speed in speeds], axis=0))


def is_slow(signals: Signals) -> BoolArray:
    """Return a mask of rows with a speed below `MOVING_MPS`: the car's own, else its wheels'.

    A label is noise there, and no estimate is compared with it. The shape is (1,) without a speed.
    """
    speed, wheels = np.full(1, np.nan), wheel_speed_mps(signals)
    sources = [np.abs(signals[name]) for name in OWN_SPEEDS if name in signals]
    for source in sources if wheels is None else [*sources, wheels]:
        speed = np.where(np.isfinite(speed), speed, source)
    return speed < MOVING_MPS


def slope_of(values: FloatArray, expected: FloatArray, rows: BoolArray) -> tuple[float, float]:
    """Return the least-squares slope of values on expected ones, and their correlation.

    Both are about the means, and 0 for too few rows.
    """
    (slope,), _, explained = fit(values, expected[None], rows)
    return float(slope), math.copysign(math.sqrt(max(explained, 0.0)), slope)


def fit(y: FloatArray, inputs: FloatArray, rows: BoolArray) -> tuple[FloatArray, float, float]:
    """Return coefficients of inputs, the constant, and the share of variance that they explain."""
    rows = rows & np.isfinite(y) & np.isfinite(inputs).all(axis=0)
    if rows.sum() < MIN_TICKS:
        return np.zeros(len(inputs)), 0.0, 0.0
    means, mean = inputs[:, rows].mean(axis=1), y[rows].mean()
    x, centred = inputs[:, rows] - means[:, None], y[rows] - mean
    total = float(centred @ centred)
    if not total > 0:
        return np.zeros(len(inputs)), 0.0, 0.0
    coefficients = np.linalg.lstsq(x @ x.T, x @ centred, rcond=1e-12)[0]
    residual = centred - coefficients @ x
    constant = float(mean - coefficients @ means)
    return coefficients, constant, 1 - float(residual @ residual) / total


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Return the angle from -π on, below π."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


# Mean moments of drives in float64, for statistics that compare drives with one another.


@dataclass(frozen=True)
class MeanMoments:
    """Mean of u u' over each drive's rows, with u = (1, counts).

    Attributes
    ----------
    signals
        K names.
    matrices
        Shape (drives, k+1, k+1).
    """

    signals: tuple[str, ...]
    matrices: FloatArray

    @classmethod
    def from_table(cls, table: "GramTable") -> "MeanMoments":
        """Divide the sums of a table by its rows."""
        n = table.n.astype(np.float64)
        return cls(table.signals, table.moments() / n[:, None, None])

    @classmethod
    def from_rows(cls, values: Mapping[str, FloatArray], rows: BoolArray) -> "MeanMoments":
        """Return the moments of some rows of one drive, each signal about its mean."""
        table = np.array([signal[rows] for signal in values.values()])
        table -= table.mean(axis=1, keepdims=True)
        matrix = np.eye(len(table) + 1)
        matrix[1:, 1:] = table @ table.T / table.shape[1]
        return cls(tuple(values), matrix[None])

    def in_si(self, signals: SignalCatalog) -> "MeanMoments":
        """Return the moments of the values in SI units."""
        scales = np.array([1.0, *(float(signals[name].scale) for name in self.signals)])
        return MeanMoments(self.signals, self.matrices * np.outer(scales, scales))

    def take(self, drives: Any) -> "MeanMoments":
        """Return the moments of some drives, by mask or number."""
        return MeanMoments(self.signals, self.matrices[drives])

    def position(self, signal: str) -> int:
        """Return the index of a signal in u."""
        return self.signals.index(signal) + 1

    def exchanged(self, a: str, b: str) -> "MeanMoments":
        """Return the moments with two signals exchanged."""
        order = np.arange(len(self.signals) + 1)
        i, j = self.position(a), self.position(b)
        order[[i, j]] = order[[j, i]]
        return MeanMoments(self.signals, self.matrices[:, order][:, :, order])

    def covariances(self) -> FloatArray:
        """Return the covariance matrices of the counts, shape (drives, k, k)."""
        mean = self.matrices[:, 0, 1:]
        return np.asarray(self.matrices[:, 1:, 1:] - mean[:, :, None] * mean[:, None, :])

    def correlations(self) -> FloatArray:
        """Return the correlation matrices, shape (drives, k, k); 0 of constant signals."""
        covariances = self.covariances()
        std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))
        product = std[:, :, None] * std[:, None, :]
        empty = np.zeros_like(product)
        return np.asarray(np.divide(covariances, product, out=empty, where=product > 0))
