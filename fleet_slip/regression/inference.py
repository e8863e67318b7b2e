"""How much each signal of an order contributes, and how much data says so.

In the orthogonal basis of a nested order, signal j has the squared length A_j in units of the
noise, and every criterion is a price on it. Neighbouring rows at 100 Hz are not independent, so the
evidence that decides is over drives.

Do two sets of drives have the same coefficients? Wald's test by clusters.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.errors import DataError
from fleet_slip.regression import exact
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.exact import inverse_matrix
from fleet_slip.regression.figures import f_upper, student_t_two_sided
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import Fit, Scales, dependence, moments

# A test of two sets of coefficients that holds its level with few clusters, from Gram rows alone.
#
# Residuals of a cluster shrink with its leverage, and a sandwich of few is uncertain. CR2 (Bell
# and McCaffrey, Survey Methodology 28, 2002) multiplies the residuals by (I - H_g)^(-1/2), H_g
# their block of the hat matrix; degrees of freedom are Zhang's for Hotelling's T^2 (Pustejovsky
# and Tipton, JBES 36, 2018, section 3.2). Both take rows for independent only for the mean of a
# matrix.
#
# No row is needed: in inputs x~ whose moments are I, with N_g those of a cluster, X~' (I - X~
# X~')^(-1/2) = (I - N_g)^(-1/2) X~'. So scores are multiplied by S_g = (I - N_g)^(-1/2);
# covariances are S_g N_g S_g within a cluster, and -S_g N_g N_h S_h between two.

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
    eta = size * (size + 1) / _variance_of_estimate(np.asarray(singles), doubles)
    denominator = eta - size + 1
    if denominator <= 0:
        raise DataError(
            f"{len(numbers)} clusters are worth {eta:.1f} of like leverage, too few to compare "
            f"{size} coefficients by. Take fewer signals."
        )
    whitened = whiten @ difference
    square = float(whitened @ np.linalg.solve(moved @ moved.T, whitened))
    return square * denominator / (eta * size), denominator


def variances_of_few(one: ClusteredFit) -> tuple[FloatArray, FloatArray]:
    """Return the CR2 variance of each coefficient, and Satterthwaite's degrees of freedom.

    The variance is a sum of squares, one a cluster. With P the covariance of what is squared, were
    rows independent, they are (tr P)^2 / tr P^2.
    """
    clusters = len(one.moments)
    part = _adjust(one, np.arange(clusters), clusters)
    contrasts = part.scale
    single = np.einsum("ja,gab,jb->jg", contrasts, part.single, contrasts, optimize=True)
    double = np.einsum("ja,gab->jgb", contrasts, part.double)
    shared = (double**2).sum(axis=2)
    trace = (single - shared).sum(axis=1)
    square = (single**2 - 2 * single * shared).sum(axis=1)
    square += ((double.swapaxes(1, 2) @ double) ** 2).sum(axis=(1, 2))
    degrees = np.divide(trace**2, square, out=np.full(len(trace), clusters - 1.0), where=square > 0)
    return (part.moved**2).sum(axis=1), degrees


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


def _variance_of_estimate(single: FloatArray, double: FloatArray) -> float:
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


INTERCEPT = "intercept"


@dataclass(frozen=True)
class Estimate:
    """A coefficient or the "intercept" in physical units.

    p is two-sided, by t = value / error with so many degrees of freedom.
    """

    name: str
    value: float
    standard_error: float
    t: float
    p: float
    degrees_of_freedom: float


@dataclass(frozen=True)
class Inference:
    """Coefficients, the intercept first if any, and the standard deviation of residuals."""

    estimates: tuple[Estimate, ...]
    residual_std: float
    degrees_of_freedom: int
    """Pieces of independent evidence less one, or of rows what the fit leaves."""


def noise_variance(fitted: Fit) -> Fraction:
    """Return sigma^2 = RSS / (n - k - 1) in counts^2. Raises `DataError` for too few rows."""
    if fitted.degrees_of_freedom <= 0:
        raise DataError(
            f"{fitted.gram.n} rows are too few to estimate the noise of a model with "
            f"{fitted.size} signals."
        )
    return fitted.rss / fitted.degrees_of_freedom


def classical_variances(fitted: Fit, variance: Fraction) -> list[Fraction]:
    """Return Var b0 = sigma^2 (1/n + m'S^-1 m) and Var b = sigma^2 S^-1, in counts, exactly."""
    inputs, gram = fitted.model.signals, fitted.gram
    scale = gram.n if fitted.has_intercept else 1
    part = gram.restrict(inputs)
    inverse = inverse_matrix(moments(part, intercept=fitted.has_intercept))
    slopes = [variance * scale * inverse[i][i] for i in range(fitted.size)]
    if not fitted.has_intercept:
        return slopes
    k = range(fitted.size)
    # S^-1 = n N^-1 and m = sums / n, so m'S^-1 m = sums'N^-1 sums / n.
    form = sum(part.sums[i] * inverse[i][j] * part.sums[j] for i in k for j in k)
    return [variance * (1 + form) / gram.n, *slopes]


def infer_classically(fitted: Fit, scales: Scales) -> Inference:
    """Return standard errors for independent rows, rounded once. Raises `DataError` for too few."""
    sigma2 = noise_variance(fitted)
    units = _units(fitted, scales)
    errors = [
        exact.sqrt(v * unit**2)
        for v, unit in zip(classical_variances(fitted, sigma2), units, strict=True)
    ]
    return _inference(fitted, scales, sigma2, errors, fitted.degrees_of_freedom)


def infer_by_clusters(fitted: Fit, drives: DriveMoments, scales: Scales) -> Inference:
    """Return cluster-robust standard errors, a cluster being a drive or a car.

    CR2 with Satterthwaite's degrees of freedom: the intervals of few clusters, or of such that
    differ in size, hold. Raises `DataError` for one cluster, or too few rows.
    """
    clusters = _require_clusters(len(drives.clusters), drives.unit)
    variances, degrees = variances_of_few(clustered_fit(fitted, drives))
    units = [float(unit) for unit in _units(fitted, scales)]
    errors = [math.sqrt(v) * u for v, u in zip(variances, units, strict=True)]
    sigma2 = noise_variance(fitted)
    return _inference(fitted, scales, sigma2, errors, clusters - 1, degrees.tolist())


def _to_counts(drives: DriveMoments, at: Sequence[int]) -> FloatArray:
    spread = drives.spread[[i - 1 for i in at[1:]]]
    centre = np.array([drives.centre[i - 1] for i in at[1:]], dtype=np.float64)
    back = np.diag([1.0, *(1 / spread)])
    back[0, 1:] = -centre / spread
    return np.asarray(drives.spread[-1] * back, dtype=np.float64)


def clustered_fit(fitted: Fit, drives: DriveMoments) -> ClusteredFit:
    """Return a fit by clusters, compared in counts. Raises `DataError` for too few rows."""
    at, first = _columns(fitted, drives), int(not fitted.has_intercept)
    each = drives.clusters
    numbers = np.arange(len(each)) if each.cluster is None else each.cluster
    chosen = at[first:]
    return ClusteredFit(
        moments=drives.matrix(each.packed)[:, chosen][:, :, chosen],
        scores=cluster_scores(fitted, drives)[:, first:],
        cluster=numbers,
        to_common=_to_counts(drives, at)[first:, first:],
        noise=math.sqrt(noise_variance(fitted)) / float(drives.spread[-1]),
    )


def cluster_scores(fitted: Fit, drives: DriveMoments) -> FloatArray:
    """Return each cluster's sum of (1, inputs) times residual, standardised, (clusters, k+1)."""
    w = drives.direction(fitted.model)
    scores = -drives.products_with(w)[:, _columns(fitted, drives)]
    return drives.sum_clusters(scores)


def _require_clusters(clusters: int, unit: str) -> int:
    if clusters < 2:
        otherwise = ": take drives for independent, cluster drive" if unit == "vehicle" else ""
        raise DataError(f"cluster-robust errors need at least two {unit}s{otherwise}.")
    return clusters


def variance_inflation(gram: Gram, inputs: Sequence[str]) -> dict[str, float]:
    """Return 1 / (1 - R^2) of each input on the others. Raises `DataError` if dependent."""
    relations = dependence(gram, inputs)
    if relations:
        raise DataError(relations)
    matrix = moments(gram.restrict(inputs))
    inverse = inverse_matrix(matrix)
    return {name: float(matrix[i][i] * inverse[i][i]) for i, name in enumerate(inputs)}


def _columns(fitted: Fit, drives: DriveMoments) -> list[int]:
    return [0, *(drives.signals.index(name) + 1 for name in fitted.model.signals)]


def _units(fitted: Fit, scales: Scales) -> list[Fraction]:
    label = scales[fitted.model.label]
    slopes = [label / scales[name] for name in fitted.model.signals]
    return [label, *slopes] if fitted.has_intercept else slopes


def _inference(
    fitted: Fit,
    scales: Scales,
    sigma2: Fraction,
    errors: Sequence[float],
    degrees: int,
    each: Sequence[float] = (),
) -> Inference:
    model = fitted.model.physical(scales)
    names = [INTERCEPT] if fitted.has_intercept else []
    values = [model.offset] if fitted.has_intercept else []
    estimates = []
    for name, value, error, of_t in zip(
        [*names, *model.signals],
        [*values, *model.weights.values()],
        errors,
        each or [float(degrees)] * len(errors),
        strict=True,
    ):
        t = value / error if error else math.copysign(math.inf, value)
        p = student_t_two_sided(t, of_t)
        estimates.append(Estimate(name, value, error, t, p, of_t))
    residual_std = exact.sqrt(sigma2 * scales[fitted.model.label] ** 2)
    return Inference(tuple(estimates), residual_std, degrees)


@dataclass(frozen=True)
class Evidence:
    """What the data says about the k+1 nested models of an order; variances are in counts^2.

    Attributes:
        contributions: A_j of each signal of the order.
        rows: number of independent rows, at most the number of rows.
        design_effect: variance of an estimate over what independent rows would give.
        kind: "rows" if rows count as independent, "drives" or "vehicles" if only those do.
    """

    contributions: tuple[float, ...]
    rows: float
    design_effect: float
    variance: float
    full_rss: float
    kind: Literal["rows", "drives", "vehicles"]

    @classmethod
    def naive(cls, fits: Sequence[Fit]) -> "Evidence":
        """A_j = (RSS_{j-1} - RSS_j) / sigma^2 of k+1 nested fits. Raises `DataError`."""
        full, variance = fits[-1], _variance(fits[-1])
        return cls(
            tuple(float(gain / variance) for gain in _gains(fits)),
            float(full.gram.n),
            1.0,
            float(variance),
            float(full.rss),
            "rows",
        )

    @classmethod
    def clustered(cls, fits: Sequence[Fit], drives: DriveMoments) -> "Evidence":
        """Take drives, or cars, for independent: A_j is a squared cluster-robust t value.

        With q_j the orthogonal direction of signal j and e the full model's residuals, A_j =
        (q_j'y)^2 / (c sum_p (q_j'e)_p^2) over clusters p. Its ratio to the naive A_j is the
        direction's design effect (Kish 1965); rows over the mean effect are effective, at least k +
        2. Raises `DataError`.
        """
        full, variance = fits[-1], _variance(fits[-1])
        at = _columns(full, drives)
        total = drives.matrix(drives.packed.sum(axis=0))[np.ix_(at, at)]
        scores = cluster_scores(full, drives)
        rotated = np.linalg.solve(np.linalg.cholesky(total), scores.T)[1:]
        unit = float(drives.spread[-1]) ** 2
        clusters = _require_clusters(len(scores), drives.unit)
        factor = clusters / (clusters - 1) * (full.gram.n - 1) / full.degrees_of_freedom
        noise = factor * np.sum(rotated**2, axis=1) * unit
        gains = np.array([float(gain) for gain in _gains(fits)])
        effects = noise / float(variance)
        effect = float(effects.mean()) if len(effects) else 1.0
        rows = min(full.gram.n, max(full.gram.n / effect, full.size + 2))
        return cls(
            tuple((gains / noise).tolist()),
            float(rows),
            effect,
            float(variance),
            float(full.rss),
            "vehicles" if drives.unit == "vehicle" else "drives",
        )

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "contributions": list(self.contributions),
            "distances_to_full": self.excess().tolist(),
            "expected_distances": list(self.distances()),
            "evidence": self.kind,
            "effective_rows": self.rows,
            "design_effect": self.design_effect,
        }

    @property
    def inputs(self) -> int:
        """Number of signals of the order, k."""
        return len(self.contributions)

    def excess(self) -> FloatArray:
        """Return sum_{i>j} A_i for j = 0..k: what leaving out the rest costs."""
        tail = np.cumsum([0.0, *reversed(self.contributions)])[::-1]
        return np.ascontiguousarray(tail)

    def excess_of(self, rss: FloatArray) -> FloatArray:
        """Return the same for any subset models, from their residual sums of squares."""
        return np.asarray((rss - self.full_rss) / (self.variance * self.design_effect))

    def distances(self) -> tuple[float, ...]:
        """Return unbiased D_j = sum_{i>j} A_i + 2j - k of equation (2), j = 0..k (Mallows 1973)."""
        size = np.arange(self.inputs + 1)
        return tuple((self.excess() + 2 * size - self.inputs).tolist())


def _gains(fits: Sequence[Fit]) -> list[Fraction]:
    return [a.rss - b.rss for a, b in pairwise(fits)]


def _variance(full: Fit) -> Fraction:
    variance = noise_variance(full)
    if variance == 0:
        raise DataError(
            f"{full.model.label} is an exact linear combination of "
            f"{', '.join(full.model.signals)}: there is no noise to compare models by. "
            "Leave out the signal that contains the label."
        )
    return variance


@dataclass(frozen=True)
class FTest:
    """An F test that sets of drives share coefficients; p is of a larger f if they do."""

    f: float
    numerator: int
    denominator: float
    p: float


def wald_test(one: Fit, one_drives: DriveMoments, other: Fit, other_drives: DriveMoments) -> FTest:
    """Compare the coefficients of the same model fitted to two sets of drives.

    Wald's statistic d'V^-1 d of their difference, V clustered and corrected for few of them, judged
    as Hotelling's T^2 (`few_clusters`); neighbouring rows need not be independent. Clusters of the
    same number are the same car. Raises `DataError` where clusters are too few.
    """
    unit, first = one_drives.unit, int(not one.has_intercept)
    size = one.size + 1 - first
    if min(len(one_drives.clusters), len(other_drives.clusters)) <= size:
        raise DataError(
            f"comparing {size} coefficients by {unit}s needs more than {size} {unit}s in each "
            "cohort."
        )
    gap = [a - b for a, b in zip(_numbers(one)[first:], _numbers(other)[first:], strict=True)]
    fits = clustered_fit(one, one_drives), clustered_fit(other, other_drives)
    if unit == "drive":  # none is in both
        fits = fits[0], replace(fits[1], cluster=fits[1].cluster + 1 + fits[0].cluster.max())
    f, degrees = hotelling(np.array([float(x) for x in gap]), fits)
    return FTest(f, size, degrees, f_upper(f, size, degrees))


def _numbers(fitted: Fit) -> list[Fraction]:
    return [fitted.model.intercept, *fitted.model.coefficients]
