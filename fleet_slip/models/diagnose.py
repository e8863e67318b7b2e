"""Diagnosis of a model's fit to a cohort: errors, collinearity, stability."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from fleet_slip.base import pluralize
from fleet_slip.grams.cohort import Cohort, DownweightedDrive, clustered_moments
from fleet_slip.models.select import outlier_drives
from fleet_slip.models.summary import outlier_remarks
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.inference import (
    INTERCEPT,
    ClusterUnit,
    Evidence,
    Inference,
    infer,
    variance_inflation,
)
from fleet_slip.regression.least_squares import Fit, condition_number
from fleet_slip.rendering import Answer, Part, Remark, TextTable


@dataclass(frozen=True)
class Diagnosis(Answer):
    """Diagnosis of one model on one cohort; coefficients are in SI units.

    Attributes
    ----------
    fitted
        Exact fit, in counts.
    cluster
        Independent units of `robust` and `evidence`; rows for a single drive.
    inflation
        Variance inflation of each input.
    condition_number
        Condition number of the inputs' correlation matrix.
    evidence
        Effective rows and design effect.
    units
        Units of the inputs and the intercept, by name.
    weighted
        The drives that `robust` of a selection would down-weight, by name.
    remark
        Remark that the filter of a model is not examined; empty without a filter.
    """

    DOCUMENT = (
        "signals=fitted.model.signals drives cluster clusters rows=fitted.gram.n "
        "effective_rows=evidence.rows design_effect=evidence.design_effect "
        "r_squared=fitted.r_squared residual_std=naive.residual_std condition_number "
        "variance_inflation=inflation by_rows=naive.estimates by_clusters=robust.estimates "
        "drives_weighed=weighted? remark?"
    )

    fitted: Fit = field(repr=False)  # holds a Gram matrix and long fractions
    drives: int
    cluster: ClusterUnit | Literal["row"]
    naive: Inference
    robust: Inference
    inflation: Mapping[str, float]
    condition_number: float
    evidence: Evidence
    units: Mapping[str, str]
    weighted: Mapping[str, DownweightedDrive] = field(default_factory=dict)
    remark: str = ""

    @property
    def clusters(self) -> int:
        """Number of independent clusters."""
        return self.robust.degrees_of_freedom + 1 if self.cluster != "row" else 1

    def parts(self) -> Iterator[Part]:
        """Return the coefficients with their errors, and the outlier drives."""
        both = zip(self.robust.estimates, self.naive.estimates, strict=True)
        rows = (
            {
                "robust": robust,
                "naive": naive,
                "unit": self.units[robust.name],
                "vif": self.inflation.get(robust.name),
            }
            for robust, naive in both
        )
        yield TextTable(
            f"{pluralize(self.drives, 'drive')}, {pluralize(self.fitted.gram.n, 'row')}, "
            f"{self.evidence.rows:,.0f} effective; R squared {self.fitted.r_squared:.4f}, "
            f"condition number {self.condition_number:.3g} (1: independent signals)",
            f"signal|unit|coefficient|s.e. by {self.cluster}s|t|s.e. by rows|VIF",
            rows,
            "{robust.name}|{unit}|{robust.value:.6g}|{robust.standard_error:.2g}|{robust.t:.1f}|"
            "{naive.standard_error:.2g}|{vif:.3g}",
            text_columns=2,
        )
        if self.cluster == "row":
            yield Remark(
                "only one drive or trip: standard errors take its rows as independent, which they "
                "are not at 100 Hz, and are far too small."
            )
        yield from outlier_remarks(self.weighted)
        if self.remark:
            yield Remark(self.remark)


def diagnose(cohort: Cohort, inputs: Sequence[str], *, intercept: bool = True) -> Diagnosis:
    """Fit the inputs to the drives of a cohort that have them all, and examine the fit.

    Raises `DataError` for dependent or absent signals.
    """
    catalog = cohort.catalog
    label, scales = catalog.signals.label, catalog.input_scales
    served = cohort.complete_cases(inputs)
    moments = clustered_moments(served, intercept=intercept)
    # Errors of a single drive or trip are by rows: there are no clusters to compare.
    alone = len(moments) < 2
    total = served.table.total()
    fits = nested_fits(total if intercept else total.about_origin(), inputs, label)
    fitted = fits[-1]
    naive = infer(fitted, scales)
    return Diagnosis(
        fitted=fitted,
        drives=len(served.table),
        cluster="row" if alone else moments.unit,
        naive=naive,
        robust=naive if alone else infer(fitted, scales, moments),
        inflation=variance_inflation(total, inputs),
        condition_number=condition_number(total, inputs),
        evidence=Evidence.measure(fits, moments),
        units={name: catalog.input(name).unit for name in inputs}
        | {INTERCEPT: catalog.signals[label].unit},
        weighted=outlier_drives(served, intercept=intercept),
    )
