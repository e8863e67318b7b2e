"""A test of two sets of coefficients that holds its level with few clusters, from Gram rows alone.

Residuals of a cluster shrink with its leverage, and a sandwich of few is uncertain. CR2 (Bell and
McCaffrey, Survey Methodology 28, 2002) multiplies the residuals by (I - H_g)^(-1/2), H_g their
block of the hat matrix; degrees of freedom are Zhang's for Hotelling's T^2 (Pustejovsky and Tipton,
JBES 36, 2018, section 3.2). Both take rows for independent only for the mean of a matrix.

No row is needed: in inputs x~ whose moments are I, with N_g those of a cluster, X~' (I - X~
X~')^(-1/2) = (I - N_g)^(-1/2) X~'. So scores are multiplied by S_g = (I - N_g)^(-1/2); covariances
are S_g N_g S_g within a cluster, and -S_g N_g N_h S_h between two.
"""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.errors import DataError

SINGULAR = 1e-9
"""A direction of which one cluster has all but so little: without it nothing is known of it."""


@dataclass(frozen=True)
class ClusteredFit:
    """Least squares over clusters, in any coordinates of inputs and label.

    Attributes:
        moments: of the inputs of each cluster, shape (clusters, q, q).
        scores: sums of inputs times residual, shape (clusters, q).
        cluster: a number of each, the same for the same cluster of another fit.
        to_common: from these coordinates to the coefficients that are compared, shape (q, q).
        noise: standard deviation of rows, in units of the label here.
    """

    moments: FloatArray
    scores: FloatArray
    cluster: IntArray
    to_common: FloatArray
    noise: float


@dataclass(frozen=True)
class _Adjusted:
    """The parts of one fit: how each cluster moves the coefficients, and its covariances."""

    moved: FloatArray
    scale: FloatArray
    single: FloatArray
    double: FloatArray


def hotelling(
    difference: FloatArray, fits: tuple[ClusteredFit, ClusteredFit]
) -> tuple[float, float]:
    """Return F and its denominator's degrees of freedom (the numerator's are q) for a difference.

    A cluster may be in both fits. Raises `DataError` for too few, or too much leverage.
    """
    size = len(difference)
    numbers = np.unique(np.concatenate([one.cluster for one in fits]))
    parts = [_adjust(one, np.searchsorted(numbers, one.cluster), len(numbers)) for one in fits]
    expected = sum(part.scale @ part.scale.T for part in parts)
    unit = np.sqrt(np.diag(expected))  # coefficients may be of very different sizes
    values, vectors = np.linalg.eigh(expected / np.outer(unit, unit))
    whiten = (vectors / np.sqrt(values)).T / unit
    moved = whiten @ (parts[0].moved - parts[1].moved)
    contrasts = [whiten @ part.scale for part in parts]
    singles = sum(
        np.asarray(c @ part.single @ c.T) for c, part in zip(contrasts, parts, strict=True)
    )
    doubles = np.concatenate(
        [c @ part.double for c, part in zip(contrasts, parts, strict=True)], axis=2
    )
    eta = size * (size + 1) / _variance(np.asarray(singles), doubles)
    denominator = eta - size + 1
    if denominator <= 0:
        raise DataError(
            f"{len(numbers)} clusters are worth {eta:.1f} of like leverage, too few to compare "
            f"{size} coefficients by. Take fewer signals."
        )
    whitened = whiten @ difference
    square = float(whitened @ np.linalg.solve(moved @ moved.T, whitened))
    return square * denominator / (eta * size), denominator


def _adjust(one: ClusteredFit, at: IntArray, clusters: int) -> _Adjusted:
    """Return the parts of a fit, for the clusters of both; those that it has not have zeros."""
    lower = np.linalg.cholesky(one.moments.sum(axis=0))
    back = np.linalg.inv(lower)
    leverage = back @ one.moments @ back.T
    values, vectors = np.linalg.eigh(np.eye(len(lower)) - leverage)
    inverse = np.where(values > SINGULAR, 1 / np.sqrt(np.maximum(values, SINGULAR)), 0.0)
    root = (vectors * inverse[:, None, :]) @ vectors.swapaxes(1, 2)
    scores = np.einsum("gij,gj->gi", root, one.scores @ back.T)
    scale = one.to_common @ back.T
    moved = np.zeros((len(lower), clusters))
    moved[:, at] = scale @ scores.T
    double = np.zeros((clusters, *lower.shape))
    double[at] = root @ leverage
    single = np.zeros((clusters, *lower.shape))
    single[at] = double[at] @ root
    return _Adjusted(moved, one.noise * scale, single, double)


def _variance(single: FloatArray, double: FloatArray) -> float:
    """Return the sum of the variances of all entries of the covariance, in units of its mean.

    With P_gh = [g = h] D_g - K_g K_h', sum (tr P_gh)^2 + tr(P_gh P_gh) over pairs; the second
    factors: sum |B_ac|^2 + <B_ac, B_ac'>, B_ac the products of rows a and c of K_g over clusters.
    """
    size = double.shape[1]
    pairs = 0.0
    for a in range(size):
        for c in range(size):
            product = double[:, a].T @ double[:, c]
            pairs += float((product**2).sum() + (product * product.T).sum())
    own = double @ double.swapaxes(1, 2)
    return pairs + _both(single - own) - _both(own)


def _both(matrices: FloatArray) -> float:
    traces = np.einsum("gii->g", matrices)
    return float((traces**2).sum() + np.einsum("gij,gji->", matrices, matrices))
