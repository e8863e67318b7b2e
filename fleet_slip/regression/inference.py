"""Standard errors of coefficients, contributions of signals, and shrinkage within groups.

In the orthogonal basis of a nested order, signal j has the squared length A_j in units of the
noise; every criterion compares it with a price. Neighbouring rows at 100 Hz are not independent, so
the evidence is taken over drives.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Literal

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.base import Record
from fleet_slip.errors import DataError
from fleet_slip.regression import exact
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.regression.least_squares import Fit, LinearModel, Scales, dependence, moments

ClusterUnit = Literal["drive", "vehicle"]
"""The independent unit of evidence: a cluster."""


@dataclass(frozen=True)
class DriveMoments:
    """Moments of u = (1, (count - centre) / spread) of drives or clusters. The label is last.

    Attributes
    ----------
    signals : tuple of str
        The k signals.
    centre : tuple of int, shape (k,)
        Mean count over all drives, rounded.
    spread : float array, shape (k,)
        Standard deviation of the counts; 1 for a constant.
    moments : float array, shape (clusters, k + 1, k + 1)
        Sums of products of u.
    unit : str
        The independent unit: drives of a vehicle share its biases and tyres.
    """

    signals: tuple[str, ...]
    centre: tuple[int, ...]
    spread: FloatArray
    moments: FloatArray
    unit: ClusterUnit = "drive"

    @classmethod
    def from_table(
        cls, table: GramTable, cluster: IntArray | None = None, unit: ClusterUnit = "drive"
    ) -> "DriveMoments":
        """Scale a table of drives and sum it by cluster; without clusters each drive is one.

        Raises `DataError` without rows.
        """
        total = table.total()
        if total.n == 0:
            raise DataError(f"no rows have all of {', '.join(table.signals)}.")
        centre = tuple(round(s / total.n) for s in total.sums)
        squares = np.array(
            [row[i] for i, row in enumerate(total.centered_products())], dtype=np.float64
        )
        spread = np.where(squares > 0, np.sqrt(squares) / total.n, 1.0)
        unit_of_u = np.array([1.0, *spread])
        moments = table.about(centre).moments() / np.outer(unit_of_u, unit_of_u)
        if cluster is not None:
            order = np.argsort(cluster, kind="stable")
            _, first = np.unique(cluster[order], return_index=True)
            moments = np.add.reduceat(moments[order], first, axis=0)
        return cls(table.signals, centre, spread, moments, unit)

    def __len__(self) -> int:
        return len(self.moments)

    def direction(self, model: LinearModel) -> FloatArray:
        """Return w with w'u = prediction minus label, in spreads of the label; model in counts."""
        if model.label != self.signals[-1]:
            raise ValueError(f"the moments end with {self.signals[-1]}, not {model.label}")
        weights = dict(zip(model.signals, model.coefficients, strict=True))
        inputs = self.signals[:-1]
        level = model.intercept - self.centre[-1]
        level += sum(weights.get(s, 0) * c for s, c in zip(inputs, self.centre, strict=False))
        unit = self.spread[-1]
        slopes = [
            float(weights.get(s, 0)) * spread / unit
            for s, spread in zip(inputs, self.spread, strict=False)
        ]
        return np.array([float(level) / unit, *slopes, -1.0])


# Standard errors that are valid for few clusters, from Gram rows.
#
# Residuals of a cluster shrink with its leverage, and a sandwich of few is uncertain. CR2 (Bell
# and McCaffrey, Survey Methodology 28, 2002) multiplies the residuals by (I - H_g)^(-1/2), H_g
# their block of the hat matrix; degrees of freedom are Satterthwaite's (Imbens and Kolesar, Review
# of Economics and Statistics 98, 2016). Both assume independent rows only for the mean of a
# matrix.
#
# No row is needed: in inputs x~ whose moments are I, with N_g those of a cluster, X~' (I - X~
# X~')^(-1/2) = (I - N_g)^(-1/2) X~'. So scores are multiplied by S_g = (I - N_g)^(-1/2);
# covariances are S_g N_g S_g within a cluster, and -S_g N_g N_h S_h between two.

SINGULAR = 1e-9
"""Share of a direction outside one cluster below which only that cluster determines it."""


def clustered_variances(fitted: Fit, drives: DriveMoments) -> tuple[FloatArray, FloatArray]:
    """Return cluster-robust variances of the coefficients (CR2).

    The degrees of freedom are Satterthwaite's, (tr P)^2 / tr P^2, with P the covariance of the
    scores if rows were independent.

    Parameters
    ----------
    fitted : Fit
    drives : DriveMoments

    Returns
    -------
    tuple of (float array, float array)
        Variance in counts and degrees of freedom of each coefficient, the intercept first if any.

    References
    ----------
    Bell and McCaffrey, Survey Methodology 28, 2002.
    Imbens and Kolesar, Review of Economics and Statistics 98, 2016.
    """
    at, first = _columns(fitted, drives), int(not fitted.has_intercept)
    chosen = at[first:]
    cluster_moments = drives.moments[:, chosen][:, :, chosen]
    back = np.linalg.inv(np.linalg.cholesky(cluster_moments.sum(axis=0)))
    leverage = back @ cluster_moments @ back.T
    values, vectors = np.linalg.eigh(np.eye(len(back)) - leverage)
    inverse = np.where(values > SINGULAR, 1 / np.sqrt(np.maximum(values, SINGULAR)), 0.0)
    root = (vectors * inverse[:, None, :]) @ vectors.swapaxes(1, 2)
    scores = np.einsum("gij,gj->gi", root, cluster_scores(fitted, drives)[:, first:] @ back.T)
    scale = _to_counts(drives, at)[first:, first:] @ back.T
    double = root @ leverage
    single = np.einsum("ja,gab,jb->jg", scale, double @ root, scale, optimize=True)
    pairs = np.einsum("ja,gab->jgb", scale, double)
    shared = (pairs**2).sum(axis=2)
    trace = (single - shared).sum(axis=1)
    square = (single**2 - 2 * single * shared).sum(axis=1)
    square += ((pairs.swapaxes(1, 2) @ pairs) ** 2).sum(axis=(1, 2))
    clusters = np.full(len(trace), len(cluster_moments) - 1.0)
    degrees = np.divide(trace**2, square, out=clusters, where=square > 0)
    return ((scale @ scores.T) ** 2).sum(axis=1), degrees


INTERCEPT = "intercept"


@dataclass(frozen=True)
class Estimate:
    """A coefficient or the "intercept" in physical units.

    p is two-sided, of t = value / standard_error with `degrees_of_freedom`.
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
    """Clusters minus one, or rows minus the number of coefficients."""


def noise_variance(fitted: Fit) -> Fraction:
    """Return the variance of the noise, sigma^2 = RSS / (n - k - 1), in counts^2.

    Parameters
    ----------
    fitted : Fit

    Returns
    -------
    Fraction

    Raises
    ------
    DataError
        If there are too few rows.
    """
    if fitted.degrees_of_freedom <= 0:
        raise DataError(
            f"{fitted.gram.n} rows are too few to estimate the noise of a model with "
            f"{fitted.size} signals."
        )
    return fitted.rss / fitted.degrees_of_freedom


def classical_variances(fitted: Fit, variance: Fraction) -> list[Fraction]:
    """Return the variances of the coefficients for independent rows, exactly.

    Var b0 = sigma^2 (1/n + m'S^-1 m) and Var b = sigma^2 S^-1.

    Parameters
    ----------
    fitted : Fit
    variance : Fraction
        Variance sigma^2 of the noise, in counts^2.

    Returns
    -------
    list of Fraction
        In counts, the intercept first if any.
    """
    gram, part = fitted.gram, fitted.gram.restrict(fitted.model.signals)
    inverse, denominator = exact.invert(moments(part))
    unit = variance * gram.n / denominator
    k = range(fitted.size)
    slopes = [unit * inverse[i][i] for i in k]
    if not fitted.has_intercept:
        return slopes
    # S^-1 = n N^-1 and m = sums / n, so m'S^-1 m = sums'N^-1 sums / n.
    form = sum(part.sums[i] * inverse[i][j] * part.sums[j] for i in k for j in k)
    return [variance * (1 + Fraction(form, denominator)) / gram.n, *slopes]


def infer(fitted: Fit, scales: Scales, drives: DriveMoments | None = None) -> Inference:
    """Return standard errors of the coefficients: for independent rows, or by clusters (CR2).

    By clusters, degrees of freedom are Satterthwaite's, so that intervals hold for few clusters and
    for unequal ones.

    Parameters
    ----------
    fitted : Fit
    scales : mapping of str to Fraction
        Physical value of one count of each signal.
    drives : DriveMoments, optional
        Two or more clusters, drives or vehicles. Default: rows are independent, and each error is
        computed exactly and rounded once.

    Returns
    -------
    Inference

    Raises
    ------
    DataError
        If there are too few rows.
    """
    from scipy.special import stdtr  # noqa: PLC0415 - slow

    sigma2, degrees_of_freedom = noise_variance(fitted), fitted.degrees_of_freedom
    label = scales[fitted.model.label]
    model = fitted.model.physical(scales)
    coefficients = {INTERCEPT: model.offset} if fitted.has_intercept else {}
    coefficients |= model.weights
    units = [label / scales.get(name, 1) for name in coefficients]
    if drives is None:
        variances = classical_variances(fitted, sigma2)
        errors = [exact.sqrt(v * unit**2) for v, unit in zip(variances, units, strict=True)]
        degrees = np.full(len(errors), float(degrees_of_freedom))
    else:
        degrees_of_freedom = len(drives) - 1
        robust, degrees = clustered_variances(fitted, drives)
        errors = [math.sqrt(v) * float(unit) for v, unit in zip(robust, units, strict=True)]
    estimates = []
    for (name, value), error, freedom in zip(
        coefficients.items(), errors, degrees.tolist(), strict=True
    ):
        t = value / error if error else math.copysign(math.inf, value)
        p = float(2 * stdtr(freedom, -abs(t)))
        estimates.append(Estimate(name, value, error, t, p, freedom))
    residual_std = exact.sqrt(sigma2 * label**2)
    return Inference(tuple(estimates), residual_std, degrees_of_freedom)


def _to_counts(drives: DriveMoments, at: Sequence[int]) -> FloatArray:
    spread = drives.spread[[i - 1 for i in at[1:]]]
    centre = np.array([drives.centre[i - 1] for i in at[1:]], dtype=np.float64)
    back = np.diag([1.0, *(1 / spread)])
    back[0, 1:] = -centre / spread
    return np.asarray(drives.spread[-1] * back, dtype=np.float64)


def cluster_scores(fitted: Fit, drives: DriveMoments) -> FloatArray:
    """Return the standardised scores of each cluster, sums of (1, inputs) times residual.

    Parameters
    ----------
    fitted : Fit
    drives : DriveMoments

    Returns
    -------
    float array, shape (clusters, k + 1)
    """
    scores = -(drives.moments @ drives.direction(fitted.model))
    return np.asarray(scores[:, _columns(fitted, drives)])


def variance_inflation(gram: Gram, inputs: Sequence[str]) -> dict[str, float]:
    """Return the variance inflation factor 1 / (1 - R^2) of each input on the others.

    Parameters
    ----------
    gram : Gram
    inputs : sequence of str

    Returns
    -------
    dict of str to float

    Raises
    ------
    DataError
        If inputs are linearly dependent.
    """
    relations = dependence(gram, inputs)
    if relations:
        raise DataError(relations)
    matrix = moments(gram.restrict(inputs))
    inverse, denominator = exact.invert(matrix)
    return {
        name: matrix[i][i] * inverse[i][i] / denominator  # two integers: one rounding
        for i, name in enumerate(inputs)
    }


def _columns(fitted: Fit, drives: DriveMoments) -> list[int]:
    return [0, *(drives.signals.index(name) + 1 for name in fitted.model.signals)]


@dataclass(frozen=True)
class Evidence(Record):
    """The evidence of the data for the k + 1 nested models of an order.

    Attributes
    ----------
    contributions : tuple of float, shape (k,)
        A_j of each signal: its squared length in units of the noise.
    rows : float
        Effective number of independent rows.
    design_effect : float
        Variance of an estimate over that of independent rows.
    kind : {"rows", "drives", "vehicles"}
        The independent unit.
    """

    DOCUMENT = (
        "contributions distances_to_full=excess expected_distances=distances evidence=kind "
        "effective_rows=rows design_effect"
    )

    contributions: tuple[float, ...]
    rows: float
    design_effect: float
    kind: Literal["rows", "drives", "vehicles"]

    @classmethod
    def measure(cls, fits: Sequence[Fit], drives: DriveMoments | None = None) -> "Evidence":
        """Return the evidence of independent clusters; of rows without two clusters.

        Of rows, A_j = (RSS_{j-1} - RSS_j) / sigma^2. Of clusters, A_j is a squared robust t value:
        with q_j the orthogonal direction of signal j and e the residuals of the full model,
        A_j = (q_j'y)^2 / (c sum_p (q_j'e)_p^2) over clusters p. Its ratio to that of rows is the
        design effect of the direction (Kish 1965). The effective rows are the rows over the mean
        design effect, at least k + 2.

        Parameters
        ----------
        fits : sequence of Fit, length k + 1
            Nested fits of 0 to k signals.
        drives : DriveMoments, optional

        Raises
        ------
        DataError
            If there is no noise, or too few rows.

        References
        ----------
        Kish, Survey Sampling, 1965.
        """
        full, variance = fits[-1], noise_variance(fits[-1])
        if variance == 0:
            raise DataError(
                f"{full.model.label} is an exact linear combination of "
                f"{', '.join(full.model.signals)}: there is no noise to compare models by. Leave "
                "out the signal that contains the label."
            )
        gains, rows = [a.rss - b.rss for a, b in pairwise(fits)], full.gram.n
        if drives is None or len(drives) < 2:
            contributions = tuple(float(gain / variance) for gain in gains)
            return cls(contributions, float(rows), 1.0, "rows")
        at = _columns(full, drives)
        total = drives.moments.sum(axis=0)[np.ix_(at, at)]
        scores = cluster_scores(full, drives)
        rotated = np.linalg.solve(np.linalg.cholesky(total), scores.T)[1:]
        clusters = len(scores)
        factor = clusters / (clusters - 1) * (rows - 1) / full.degrees_of_freedom
        noise = factor * np.sum(rotated**2, axis=1) * float(drives.spread[-1]) ** 2
        effect = float(np.mean(noise / float(variance))) if gains else 1.0
        return cls(
            tuple((np.array(gains, dtype=np.float64) / noise).tolist()),
            float(min(rows, max(rows / effect, full.size + 2))),
            effect,
            "vehicles" if drives.unit == "vehicle" else "drives",
        )

    @property
    def inputs(self) -> int:
        """Number of signals of the order, k."""
        return len(self.contributions)

    @property
    def excess(self) -> tuple[float, ...]:
        """Cost of leaving out the last signals, sum_{i>j} A_i for j = 0..k."""
        return tuple(np.cumsum([0.0, *reversed(self.contributions)])[::-1].tolist())

    @property
    def distances(self) -> tuple[float, ...]:
        """Unbiased D_j = sum_{i>j} A_i + 2j - k of equation (2) of the paper, for j = 0..k.

        References
        ----------
        Mallows, Technometrics 15, 1973.
        """
        return tuple(x + 2 * size - self.inputs for size, x in enumerate(self.excess))


# Shrinkage: estimates for the members of a group, each moved towards the group's mean.
#
# A member's value is the mean of the group, plus a deviation of variance A, plus an error of known
# variance V. The estimate of A maximises A times its likelihood, given the residuals: it is never
# 0, also if values differ no more than their errors. Members are shrunk by B = V / (V + A). Their
# standard errors include the uncertainties of A and of the mean:
# C. N. Morris and R. Tang, "Estimating random effects via adjustment for density maximization",
# Statistical Science 26 (2011), 271-287.

MIN_MEMBERS = 4
"""Minimum number of members: fewer do not determine their variance."""
_STEP = 1e-4


@dataclass(frozen=True)
class Pooled:
    """Values of the members of a group, shrunk towards the mean of the group.

    Attributes
    ----------
    mean, mean_error : float
        Mean of the group, with its standard error.
    spread, spread_error : float
        Standard deviation between members, sqrt(A), with its standard error.
    values, errors : float array, shape (members,)
        Shrunk values, with their standard errors.
    """

    mean: float
    mean_error: float
    spread: float
    spread_error: float
    values: FloatArray
    errors: FloatArray


def pool(values: FloatArray, variances: FloatArray) -> Pooled | None:
    """Shrink the values of the members of a group towards their mean.

    Parameters
    ----------
    values : float array, shape (members,)
    variances : float array, shape (members,)
        Above 0.

    Returns
    -------
    Pooled or None
        None for fewer than `MIN_MEMBERS` members.

    References
    ----------
    Morris and Tang, Statistical Science 26, 2011, 271-287.
    """
    if len(values) < MIN_MEMBERS:
        return None

    def slope(log_between: float) -> float:
        """Return the derivative of log(A L(A)) by log(A)."""
        between = math.exp(log_between)
        weights = 1 / (variances + between)
        squares = weights**2 * (values - _mean(values, weights)) ** 2
        steep = squares - weights + weights**2 / weights.sum()
        return 1 + between / 2 * float(steep.sum())

    from scipy.optimize import brentq  # noqa: PLC0415 - slow

    high = math.log(float(np.ptp(values)) ** 2 * len(values) + float(variances.max()) * 16)
    log_between = brentq(slope, math.log(float(variances.min())) - 16, high)
    information = (slope(log_between - _STEP) - slope(log_between + _STEP)) / (2 * _STEP)
    weights = 1 / (variances + math.exp(log_between))
    mean, shrinkage = _mean(values, weights), variances * weights
    mean_variance = 1 / float(weights.sum())
    binomial = shrinkage * (1 - shrinkage)
    shrinkage_variance = binomial**2 / (information + binomial)
    squares = (
        variances * (1 - shrinkage)
        + shrinkage**2 * mean_variance
        + shrinkage_variance * (values - mean) ** 2
    )
    spread = math.exp(log_between / 2)
    return Pooled(
        mean=mean,
        mean_error=math.sqrt(mean_variance),
        spread=spread,
        spread_error=spread / (2 * math.sqrt(information)),
        values=values + shrinkage * (mean - values),
        errors=np.sqrt(squares),
    )


def _mean(values: FloatArray, weights: FloatArray) -> float:
    return float((weights * values).sum() / weights.sum())
