"""What the training drives tell: coefficients, the order of variables, how hard cars turned."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohort import Cohort, clustered_moments
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.drives import ClusterUnit
from fleet_slip.regression.inference import (
    INTERCEPT,
    Estimate,
    infer_by_clusters,
    infer_classically,
    variance_inflation,
)
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.orders import RANKINGS, rank
from fleet_slip.regression.subsets import best_subsets
from fleet_slip.views import connect
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.tables import Warehouse


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
    """Fit the label on the inputs over a cohort. Raises `DataError` for fewer than two drives."""
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


CLOSE = 0.001
"""A model explains nearly all if it leaves no more than this of the variance to the full one."""


@dataclass(frozen=True)
class Ordering:
    """How many signals each ranking, and the best of all subsets, needs to explain nearly all."""

    signals: tuple[str, ...]
    needed: dict[str, int]
    best: int
    subsets: int


def compare_orders(cohort: Cohort, signals: Sequence[str]) -> Ordering:
    """Rank signals in every way beside all subsets. Raises `DataError` if no drive has them all."""
    label = catalogue().label
    total = cohort.serving(signals).table.total()
    best = best_subsets(total, signals, label, count=1)
    enough = best[-1].best.r_squared - CLOSE
    needed = {}
    for ranking in RANKINGS:
        fits = nested_fits(total, rank(ranking, total, signals, label), label)
        needed[ranking] = next(fit.size for fit in fits if fit.r_squared >= enough)
    return Ordering(
        signals=tuple(signals),
        needed=needed,
        best=next(size.best.size for size in best if size.best.r_squared >= enough),
        subsets=2 ** len(signals),
    )


def lateral_reach_mps2(warehouse: Warehouse, cohort: Cohort, share: float) -> float:
    """Return the size of the lateral acceleration that a share of a cohort's rows stay below."""
    statement = f"SELECT quantile_disc(abs(ay_mps2), {share}) FROM log JOIN cohort USING (drive_id)"
    with connect(warehouse.root) as database, reading_files(database, "reading training drives"):
        database.register("cohort", cohort.drives.select(["drive_id"]))
        ((found,),) = database.sql(statement).fetchall()
    return float(found or 0.0)
