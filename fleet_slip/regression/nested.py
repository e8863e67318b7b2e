"""All k+1 nested models of an order from one elimination (Section II-B of the paper)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fleet_slip.errors import DataError
from fleet_slip.regression.elimination import eliminate
from fleet_slip.regression.evidence import Evidence
from fleet_slip.regression.exact import (
    Fit,
    Scales,
    condition_number,
    dependence,
    fit_leading,
    moments,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import Inference, infer_classically, noise_variance


def nested_fits(gram: Gram, order: Sequence[str], label: str) -> list[Fit]:
    """Return the exact fits of the first 0, 1, ..., k signals of an order.

    One Bareiss pass yields every residual sum of squares (bordered over principal minors) and
    every leading triangular system. Raises `DataError` for dependent signals.
    """
    part = gram.restrict([*order, label])
    triangle = eliminate(moments(part))
    if triangle.singular is not None:
        raise DataError(dependence(part, order))
    return [fit_leading(part, triangle, size) for size in range(len(order) + 1)]


@dataclass(frozen=True)
class NestedModel:
    """One of the k+1 models of an order.

    Attributes:
        fit: exact fit in counts, with its residual sum of squares.
        inference: coefficients in physical units, errors and t, sigma^2 from the full model.
        contribution: A_j of the last added signal; 0 for the null model.
        distance: estimate of the distance D of equation (2) to the true model.
        condition_number: of the inputs' correlation matrix.
    """

    fit: Fit
    inference: Inference
    contribution: float
    distance: float
    condition_number: float

    @property
    def signals(self) -> tuple[str, ...]:
        """Its inputs, in the order of entry."""
        return self.fit.model.signals

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "size": self.fit.size,
            "signals": list(self.signals),
            "r_squared": self.fit.r_squared,
            "contribution": self.contribution,
            "distance": self.distance,
            "condition_number": self.condition_number,
            "estimates": [asdict(estimate) for estimate in self.inference.estimates],
        }


def nested_models(
    gram: Gram, order: Sequence[str], label: str, scales: Scales, evidence: Evidence | None = None
) -> list[NestedModel]:
    """Return all nested models of an order with their statistics.

    The evidence gives contributions and distances; without one, rows count as independent.
    Raises `DataError` for dependent signals, too few rows, or a label without noise.
    """
    fits = nested_fits(gram, order, label)
    known = evidence or Evidence.naive(fits)
    variance = noise_variance(fits[-1])
    distances = known.distances()
    return [
        NestedModel(
            fitted,
            infer_classically(fitted, scales, variance),
            known.contributions[size - 1] if size else 0.0,
            distances[size],
            condition_number(gram, fitted.model.signals),
        )
        for size, fitted in enumerate(fits)
    ]
