"""Weighted combination of two estimators of one quantity, chosen by cross-validation.

The estimates are those of a regression ("line") and of a filter, l and e, with their difference
z = l − e. With a share u of the clipped difference, a combination is

    β = e + u · clip(z, ±3σ)          anchored at the filter
    β = l − (1 − u) · clip(z, ±3σ)    anchored at the line

The share and σ are constants, or functions of the lateral acceleration that are linear between
knots. Where the line has no estimate, β = e.

References
----------
J. M. Bates and C. W. J. Granger, "The combination of forecasts", Operational Research Quarterly 20
(1969): the weights of least squares. Shrinking them halfway to 1/2 lowers the error of few groups.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray

KNOTS_MPS2 = (0.0, 3.0, 6.0, 9.0)
"""Lateral accelerations between which share and σ are linear."""

CLIP_STD = 3.0
"""Standard deviations σ of the difference beyond which it is clipped."""

RIDGE = 0.3
"""Ridge of the shares at knots, relative to the mean diagonal of their normal matrix."""

STD_ROWS = 0.1
"""Weight, of a total of 1, with which the σ of a knot tends to that of all rows."""

MIN_GROUPS = 4
"""Minimum number of groups of drives to replace the safest method."""

Anchor = Literal["line", "filter"]
Method = Literal["line", "filter", "constant", "by_lateral", "line_by_lateral"]

METHODS: tuple[Method, ...] = ("constant", "line", "filter", "by_lateral", "line_by_lateral")
"""All combinations, the safest first.

Attributes
----------
constant
    Constant share and σ, anchored at the filter.
line, filter
    One of both estimates.
by_lateral, line_by_lateral
    Share and σ by lateral acceleration, anchored at the filter or at the line.
"""


@dataclass(frozen=True)
class PairedEstimates:
    """Cross-validated estimates of rows that have both and a label, arrays of shape (rows,).

    Attributes
    ----------
    line, filter, label
        Angles in rad.
    lateral_mps2
        Size of the smoothed lateral acceleration.
    group
        Number of the held-out group of each row: neither estimate has seen its label.
    """

    line: FloatArray
    filter: FloatArray
    label: FloatArray
    lateral_mps2: FloatArray
    group: FloatArray

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.label)

    @property
    def groups(self) -> FloatArray:
        """Numbers of the groups."""
        return np.unique(self.group)

    @property
    def weights(self) -> FloatArray:
        """Weights of the rows, which give each group the same total; their sum is 1."""
        _, place, rows = np.unique(self.group, return_inverse=True, return_counts=True)
        weights: FloatArray = 1.0 / (rows[place] * max(len(rows), 1))
        return weights

    def where(self, rows: BoolArray) -> "PairedEstimates":
        """Return the rows of a mask."""
        return PairedEstimates(*(values[rows] for values in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: Sequence["PairedEstimates"]) -> "PairedEstimates":
        """Join estimates; groups keep their numbers."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class EstimateCombination:
    """A combination with its numbers.

    Attributes
    ----------
    anchor
        The estimate to which a share of the difference is added.
    line_share
        Share u of the line at each knot, from 0 to 1.
    std_rad
        Standard deviation σ of the difference at each knot; 0 takes the anchor alone.
    knots_mps2
        Lateral accelerations of the knots, increasing; a single one for constants.
    """

    anchor: Anchor
    line_share: tuple[float, ...]
    std_rad: tuple[float, ...]
    knots_mps2: tuple[float, ...] = (0.0,)

    def __call__(
        self, line: FloatArray, filtered: FloatArray, lateral_mps2: FloatArray
    ) -> FloatArray:
        """Combine two estimates in rad, shape (rows,); without the line it is the filter's."""
        share = np.interp(lateral_mps2, self.knots_mps2, self.line_share)
        limit = CLIP_STD * np.interp(lateral_mps2, self.knots_mps2, self.std_rad)
        clipped = np.clip(line - filtered, -limit, limit)
        combined = filtered + share * clipped
        if self.anchor == "line":
            combined = line - (1 - share) * clipped
        return np.where(np.isnan(line), filtered, combined)


LINE = EstimateCombination("line", (1.0,), (0.0,))
FILTER = EstimateCombination("filter", (0.0,), (0.0,))


def fit_combination(pairs: PairedEstimates, method: Method) -> EstimateCombination:
    """Fit the numbers of a combination.

    With weights v, which give every group the same total, the filter's weight is

        w_cv = Σ v (e − l)(y − l) / Σ v z²
        w    = clip((clip(w_cv, −1, 2) + 1/2) / 2, 0, 1)
        σ    = sqrt(Σ v z²)

    and, with the hat functions h of the knots,

        u   = (1 − w) + (A + 0.3 tr(A)/4 · I)⁻¹ b, clipped to [0, 1]
        A   = Σ v z² h hᵀ,  b = Σ v z h (y − e − (1 − w) z)
        σ_j² = (Σ v h_j z² + 0.1 σ²) / (Σ v h_j + 0.1)

    Parameters
    ----------
    pairs
        Cross-validated estimates.
    method
        The combination.

    Returns
    -------
    EstimateCombination
    """
    if method == "line":
        return LINE
    if method == "filter":
        return FILTER
    v, z = pairs.weights, pairs.line - pairs.filter
    square = float(v @ z**2)
    if square == 0.0:  # both estimates are the same
        return FILTER
    filter_weight = float(v @ (-z * (pairs.label - pairs.line))) / square
    share = 1.0 - min(max((min(max(filter_weight, -1.0), 2.0) + 0.5) / 2, 0.0), 1.0)
    if method == "constant":
        return EstimateCombination("filter", (share,), (math.sqrt(square),))
    # The hat functions of the knots, shape (knots, rows); their sum is 1.
    units = np.eye(len(KNOTS_MPS2))
    hats = np.stack([np.interp(pairs.lateral_mps2, KNOTS_MPS2, unit) for unit in units])
    normal = (hats * (v * z**2)) @ hats.T
    ridge = RIDGE * np.trace(normal) / len(hats) * np.eye(len(hats))
    moments = hats @ (v * z * (pairs.label - pairs.filter - share * z))
    shares = np.clip(share + np.linalg.solve(normal + ridge, moments), 0.0, 1.0)
    variances = (hats @ (v * z**2) + STD_ROWS * square) / (hats @ v + STD_ROWS)
    anchor: Anchor = "line" if method == "line_by_lateral" else "filter"
    return EstimateCombination(
        anchor, tuple(shares.tolist()), tuple(np.sqrt(variances).tolist()), KNOTS_MPS2
    )


@dataclass(frozen=True)
class CombinationChoice:
    """The chosen combination, fitted to all groups, and the comparison.

    Attributes
    ----------
    method, combination
        The winner.
    rmse_rad
        Cross-validated RMSE of each method, each group with the same weight.
    worst_rmse_rad
        Of each method, the RMSE of its worst group.
    groups
        Number of groups, of drives and of kinds.
    """

    method: Method
    combination: EstimateCombination
    rmse_rad: Mapping[Method, float]
    worst_rmse_rad: Mapping[Method, float]
    groups: int


def choose_combination(
    pairs: PairedEstimates, kinds: PairedEstimates | None = None
) -> CombinationChoice:
    """Choose the combination by the mean and the worst group.

    The numbers that a group is judged by come from the other groups. The criterion is the mean of
    two mean squares: of all groups, and of the worst. A method replaces the safest only if the root
    of its criterion is lower by more than a factor 1 + 1/√n, for n groups, of which there are at
    least `MIN_GROUPS`.

    Parameters
    ----------
    pairs
        Cross-validated estimates of at least one group of drives.
    kinds
        Those of kinds of driving. They judge the methods. They do not determine the numbers: a line
        that fails on another kind of driving would dominate all squares.

    Returns
    -------
    CombinationChoice
    """
    squares = {method: _group_squares(pairs, kinds, method) for method in METHODS}
    criterion = {m: math.sqrt((squares[m].mean() + squares[m].max()) / 2) for m in METHODS}
    groups, safest = len(pairs.groups), METHODS[0]
    best = min(METHODS, key=lambda method: criterion[method])
    is_clear = criterion[best] * (1 + 1 / math.sqrt(groups)) < criterion[safest]
    chosen: Method = best if is_clear and groups >= MIN_GROUPS else safest
    return CombinationChoice(
        chosen,
        fit_combination(pairs, chosen),
        {m: math.sqrt(squares[m].mean()) for m in METHODS},
        {m: math.sqrt(squares[m].max()) for m in METHODS},
        len(squares[safest]),
    )


def _group_squares(
    pairs: PairedEstimates, kinds: PairedEstimates | None, method: Method
) -> FloatArray:
    """Return the mean squared error of each group, with numbers from the other groups."""
    squares = []
    for group in pairs.groups:
        held_out = pairs.group == group
        training = pairs.where(~held_out)
        combination = fit_combination(training if len(training) else pairs, method)
        squares.append(_mean_square(combination, pairs.where(held_out)))
    if kinds is not None:
        combination = fit_combination(pairs, method)
        squares += [
            _mean_square(combination, kinds.where(kinds.group == kind)) for kind in kinds.groups
        ]
    return np.array(squares)


def _mean_square(combination: EstimateCombination, rows: PairedEstimates) -> float:
    error = combination(rows.line, rows.filter, rows.lateral_mps2) - rows.label
    return float(np.mean(error**2))
