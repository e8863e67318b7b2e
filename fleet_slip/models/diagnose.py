"""What there is to know about a model's fit to a cohort: errors, collinearity, stability."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from fleet_slip.base import Record, number_of
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohort import Cohort, Served, clustered_moments
from fleet_slip.grams.weights import Weighed
from fleet_slip.models.select import lost_drives
from fleet_slip.models.summary import lost_remarks
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.drives import (
    ClusterUnit,
    DriveMoments,
)
from fleet_slip.regression.inference import (
    INTERCEPT,
    Evidence,
    FTest,
    Inference,
    infer_by_clusters,
    infer_classically,
    variance_inflation,
    wald_test,
)
from fleet_slip.regression.least_squares import Fit, condition_number, fit
from fleet_slip.rendering import Answer, Part, Remark, TextTable


@dataclass(frozen=True)
class CohortComparison(Record):
    """Whether another cohort has the same coefficients: Wald's test; None of too few drives."""

    DOCUMENT = "cohort=condition by_clusters=other.estimates wald_clusters_independent=test"

    condition: str
    other: Inference
    test: FTest | None

    def parts(self, here: Inference, unit: str) -> Iterator[Part]:
        """Return the coefficients beside those of `here`, and the test by a unit of drives."""
        both = zip(here.estimates, self.other.estimates, strict=True)
        yield TextTable(
            f"\nthe same signals where {self.condition}",
            "signal|coefficient here|there|s.e. there",
            ({"here": one, "there": other} for one, other in both),
            "{here.name}|{here.value:.6g}|{there.value:.6g}|{there.standard_error:.2g}",
        )
        if (test := self.test) is None:
            yield Remark(
                f"there are too few {'drive' if unit == 'row' else unit}s to compare so many "
                "coefficients by them. Choose fewer signals, or more drives."
            )
        else:
            degrees = f"{test.numerator}, {test.denominator:.4g}"
            f, p = f"F({degrees}) = {test.f:,.2f}", f"p = {test.p:.2g}"
            yield f"the same coefficients? Wald, by {unit}s: {f}, {p}."


@dataclass(frozen=True)
class Diagnosis(Answer):
    """One model on one cohort; coefficients are in SI units, and None is what was not asked for.

    Attributes:
        fitted: exact fit, in counts.
        cluster: what is independent in `robust` and `evidence`; rows of a single drive.
        inflation: variance inflation of each input.
        condition_number: of the inputs' correlation matrix.
        evidence: effective rows and design effect.
        weighed: the drives that `robust` of a selection would count less, by name.
    """

    DOCUMENT = (
        "signals=fitted.model.signals drives cluster clusters rows=fitted.gram.n "
        "effective_rows=evidence.rows design_effect=evidence.design_effect "
        "r_squared=fitted.r_squared residual_std=naive.residual_std condition_number "
        "variance_inflation=inflation by_rows=naive.estimates by_clusters=robust.estimates "
        "drives_weighed=weighed? against=comparison?"
    )

    fitted: Fit = field(repr=False)  # holds a Gram matrix and long fractions
    drives: int
    cluster: ClusterUnit | Literal["row"]
    naive: Inference
    robust: Inference
    inflation: Mapping[str, float]
    condition_number: float
    evidence: Evidence
    comparison: CohortComparison | None = None
    weighed: Mapping[str, Weighed] = field(default_factory=dict)

    @property
    def clusters(self) -> int:
        """How many pieces of independent evidence there are."""
        return self.robust.degrees_of_freedom + 1 if self.cluster != "row" else 1

    def parts(self) -> Iterator[Part]:
        """Return the coefficients, and how they compare with those of another cohort."""
        both = zip(self.robust.estimates, self.naive.estimates, strict=True)
        units = {INTERCEPT: catalogue()[catalogue().label].unit}
        rows = (
            {
                "robust": robust,
                "naive": naive,
                "unit": units.get(robust.name) or features().of(robust.name).unit,
                "vif": self.inflation.get(robust.name),
            }
            for robust, naive in both
        )
        yield TextTable(
            f"{number_of(self.drives, 'drive')}, {number_of(self.fitted.gram.n, 'row')}, worth "
            f"{self.evidence.rows:,.0f} independent ones; R squared {self.fitted.r_squared:.4f}, "
            f"condition number {self.condition_number:.3g} (1: independent signals)",
            f"signal|unit|coefficient|s.e. by {self.cluster}s|t|s.e. by rows|VIF",
            rows,
            "{robust.name}|{unit}|{robust.value:.6g}|{robust.standard_error:.2g}|{robust.t:.1f}|"
            "{naive.standard_error:.2g}|{vif:.3g}",
            left=2,
        )
        if self.cluster == "row":
            yield Remark(
                "only one drive: standard errors take its rows as independent, which they are "
                "not at 100 Hz, and are far too small."
            )
        yield from lost_remarks(self.weighed)
        if self.comparison is not None:
            yield from self.comparison.parts(self.robust, self.cluster)


def diagnose(
    cohort: Cohort,
    inputs: Sequence[str],
    *,
    against: Cohort | None = None,
    cluster: ClusterUnit | None = None,
    intercept: bool = True,
) -> Diagnosis:
    """Fit the inputs to the drives of a cohort that have them all, and examine the fit.

    Raises `DataError` for dependent or absent signals.
    """
    label, scales = catalogue().label, input_scales()
    served = cohort.serving(inputs)
    there = against.serving(inputs) if against else None
    if cluster is None and any(len({*_cars(one)}) == 1 for one in (served, there) if one):
        cluster = "drive"  # several cars in all, but one only in a cohort
    moments = clustered_moments(served, cluster, _cars(served, there), intercept=intercept)
    alone = _is_alone(moments)
    total = served.table.total()
    fits = nested_fits(total, inputs, label, intercept=intercept)
    fitted = fits[-1]
    return Diagnosis(
        fitted=fitted,
        drives=len(served.table),
        cluster="row" if alone else moments.unit,
        naive=infer_classically(fitted, scales),
        robust=_infer(fitted, moments),
        inflation=variance_inflation(total, inputs),
        condition_number=condition_number(total, inputs),
        evidence=Evidence.naive(fits) if alone else Evidence.clustered(fits, moments),
        comparison=_compare(served, fitted, moments, against.condition.text, there)
        if against and there
        else None,
        weighed=lost_drives(served, intercept=intercept),
    )


def _is_alone(moments: DriveMoments) -> bool:
    """Return whether there is a single drive, which tells nothing of how drives differ."""
    return moments.unit == "drive" and len(moments) == 1


def _infer(fitted: Fit, moments: DriveMoments) -> Inference:
    """Return errors by drives or cars; of a single drive by rows, for want of anything better."""
    if _is_alone(moments):
        return infer_classically(fitted, input_scales())
    return infer_by_clusters(fitted, moments, input_scales())


def _cars(*cohorts: Served | None) -> list[str]:
    return [car for one in cohorts if one for car in one.drives["vehicle_id"].to_pylist()]


def _compare(
    here: Served, fitted: Fit, moments: DriveMoments, condition: str, there: Served
) -> CohortComparison:
    inputs, label = fitted.model.signals, fitted.model.label
    shared = {*here.drives["drive_id"].to_pylist()} & {*there.drives["drive_id"].to_pylist()}
    if shared:
        raise QuestionError(
            f"the two cohorts share {number_of(len(shared), 'drive')}, such as {min(shared)}: "
            f"a comparison needs different drives. Add to the cohort: AND NOT ({condition})"
        )
    intercept = fitted.has_intercept
    other_moments = clustered_moments(there, moments.unit, _cars(here, there), intercept=intercept)
    other = fit(there.table.total(), inputs, label, intercept=intercept)
    try:
        test = wald_test(fitted, moments, other, other_moments)
    except DataError:  # too few of them
        test = None
    return CohortComparison(condition, _infer(other, other_moments), test)
