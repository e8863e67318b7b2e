"""How far to trust a winner's figures: drawing the drives again, and dealing the folds again."""

from dataclasses import dataclass

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.folding import EACH, Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.grams.cohorts.training_folds import drive_folds
from fleet_slip.regression.inference.bootstrap import (
    Interval,
    bootstrap_correlations,
    held_out_products,
    percentile_interval,
    repeated_cross_validation,
)
from fleet_slip.regression.inference.drive_moments import ClusterUnit, DriveMoments
from fleet_slip.regression.validation.crossval import CrossValidation, least_squares

SEED = 1
"""Resampling is reproducible: the same command prints the same figures."""


@dataclass(frozen=True)
class Uncertainty:
    """What resampling says of a model's cross-validated correlation.

    Attributes:
        interval: percentile interval by cluster bootstrap.
        drawn: what is drawn for it: drives, or cars with all their drives.
        repeats: number of deals of drives into folds; with `EACH` there is no other.
        repeated_mean, repeated_spread: mean and standard deviation of the correlation over them.
    """

    interval: Interval | None
    drawn: ClusterUnit
    repeats: int
    repeated_mean: float | None
    repeated_spread: float | None


def estimate_uncertainty(
    cohort: Cohort,
    model: CrossValidation,
    folding: Folding,
    *,
    bootstrap: int | None,
    repeat: int | None,
    cluster: ClusterUnit | None = None,
    intercept: bool = True,
) -> Uncertainty:
    """Draw the drives with replacement `bootstrap` times, deal the folds anew `repeat` times.

    Of several cars, whole cars are drawn, see `clustered_moments`.

    Raises `QuestionError` for folds of rows, `DataError` for too few drives.
    """
    label = catalogue().label
    ready = drive_folds(cohort, model.signals, folding, cluster=cluster)
    interval = None
    if bootstrap:
        splits = ready.training.folds.splits()
        refit = least_squares(model.signals, label, intercept=intercept)
        models = [refit(training) for training, _ in splits]
        products = held_out_products(ready.moments, ready.fold, models)
        interval = percentile_interval(bootstrap_correlations(products, bootstrap, SEED))
    repeated = None
    if repeat and folding.count != EACH:
        moments = ready.moments if intercept else DriveMoments.of(ready.served.table, centred=False)
        repeated = repeated_cross_validation(
            moments, folding.count, repeat, SEED, intercept=intercept
        )
    return Uncertainty(
        interval,
        ready.moments.unit,
        repeat or 0,
        repeated.mean if repeated else None,
        repeated.spread if repeated else None,
    )
