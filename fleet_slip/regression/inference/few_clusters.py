"""A test of two sets of coefficients that holds its level with few clusters, from Gram rows alone.

Residuals of a cluster are smaller than its noise, the more so the larger its leverage, so that a
sandwich of them is too small; and it is far less certain than the number of clusters says where a
few of them weigh most. CR2 of Bell and McCaffrey (Survey Methodology 28, 2002) mends the first: the
residuals of a cluster are multiplied by (I - H_g)^(-1/2), H_g its block of the hat matrix. The
second is mended by the degrees of freedom of Zhang's approximation to Hotelling's T^2 after
Pustejovsky and Tipton (Journal of Business & Economic Statistics 36, 2018, section 3.2), of which
Bell and McCaffrey's are the case of one coefficient. Both take the noise of rows for independent
where they say how large a matrix is on average, and for nothing else.

No row is needed. In inputs x~ whose moments over all clusters are I, with N_g those of a cluster,
X~' (I - X~ X~')^(-1/2) = (I - N_g)^(-1/2) X~': so the sums of inputs times residual are multiplied
by S_g = (I - N_g)^(-1/2), and the covariances between clusters that the degrees of freedom take are
S_g N_g S_g for one cluster, and -S_g N_g N_h S_h for two.
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
        to_common: from coefficients in these coordinates to those that are compared, shape (q, q).
        noise: standard deviation of the noise of rows, in units of the label here.
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
    """Return F and the degrees of freedom of its denominator, those of its numerator being q.

    The difference is that of the coefficients that are compared. A cluster may be in both fits.
    Raises `DataError` where clusters are too few, or have too much leverage, to tell.
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

    With P_gh = [g = h] D_g - K_g K_h' it is the sum of (tr P_gh)^2 + tr(P_gh P_gh) over all pairs
    of clusters. That of the second term factors: with B_ac the sum over clusters of the products
    of the rows a and c of K_g, it is the sum of |B_ac|^2 + <B_ac, B_ac'> over all a and c.
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
