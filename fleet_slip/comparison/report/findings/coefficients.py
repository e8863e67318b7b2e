"""A model's coefficients with what is known of their uncertainty."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.grams.cohorts.training_folds import clustered_moments
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.inference.drive_moments import ClusterUnit
from fleet_slip.regression.inference.standard_errors import (
    INTERCEPT,
    Estimate,
    infer_by_clusters,
    infer_classically,
    variance_inflation,
)


@dataclass(frozen=True)
class Coefficient:
    """One row of a coefficient table.

    Attributes:
        estimate: of a signal or the intercept, with drives, or cars, as the independent pieces of
            evidence.
        unit: of the value.
        row_error: standard error as if every row were independent.
        share_deg: degrees of estimate for one standard deviation of the signal; None of a constant.
        inflation: variance inflation factor; None of the intercept.
    """

    estimate: Estimate
    unit: str
    row_error: float
    share_deg: float | None
    inflation: float | None


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of one model, and the data that they are from."""

    model: str
    rows: Sequence[Coefficient]
    drives: int
    cluster: ClusterUnit
    log_rows: int


def coefficient_table(
    cohort: Cohort, model: str, inputs: Sequence[str], *, intercept: bool = True
) -> Coefficients:
    """Fit the label on the inputs over all drives of a cohort that have them.

    Raises `DataError` if no drive has them, or there is one only.
    """
    label = catalogue().label
    served = cohort.serving(inputs)
    moments = clustered_moments(served, intercept=intercept)
    fitted = fit(served.table.total(), inputs, label, intercept=intercept)
    scales = input_scales()
    robust, naive = infer_by_clusters(fitted, moments, scales), infer_classically(fitted, scales)
    inflation = variance_inflation(fitted.gram, inputs)
    spread = dict(zip(moments.signals, moments.spread.tolist(), strict=True))
    rows = []
    for estimate, other in zip(robust.estimates, naive.estimates, strict=True):
        constant = estimate.name == INTERCEPT
        unit = "rad" if constant else f"rad per {features().of(estimate.name).unit}"
        share = None
        if not constant:
            deviation = spread[estimate.name] * float(scales[estimate.name])
            share = math.degrees(estimate.value * deviation)
        found = inflation.get(estimate.name)
        rows.append(Coefficient(estimate, unit, other.standard_error, share, found))
    return Coefficients(model, tuple(rows), len(moments), moments.unit, served.table.total().n)
