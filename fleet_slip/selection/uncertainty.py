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
from fleet_slip.selection.request import SelectionRequest

SEED = 1
"""Resampling is reproducible: the same command prints the same figures."""


@dataclass(frozen=True)
class Uncertainty:
    """What resampling says of a model's cross-validated correlation.

    A percentile interval, drawing drives or cars; mean and spread over `repeats` deals of folds.
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
    request: SelectionRequest,
) -> Uncertainty:
    """Draw drives, or cars of several, `bootstrap` times; deal the folds anew `repeat` times.

    Raises `QuestionError` for folds of rows, `DataError` for too few drives.
    """
    bootstrap, repeat, intercept = request.bootstrap, request.repeat, request.intercept
    label = catalogue().label
    ready = drive_folds(cohort, model.signals, folding, cluster=request.cluster)
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
