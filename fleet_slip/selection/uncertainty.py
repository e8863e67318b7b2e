"""How far to trust a winner's figures: drawing the drives again, and dealing the folds again.

The cars of a cohort whose influence no honest car has, by name, and a cohort without them.

The noise of the label, below which no error that is measured against it can be.

A cross-validated mean square error is that of the model plus the variance of the label's white
noise, since a model cannot know the noise of drives that it has not seen. Only simulated drives
state it, in the `[sensors]` of their campaign.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.grams.cohorts.cohort_origin import CohortOrigin
from fleet_slip.grams.cohorts.folding import EACH, Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort, Served
from fleet_slip.grams.cohorts.gram_reader import open_grams
from fleet_slip.grams.cohorts.training_folds import drive_folds
from fleet_slip.regression.inference.bootstrap import (
    Interval,
    bootstrap_correlations,
    held_out_products,
    percentile_interval,
    repeated_cross_validation,
)
from fleet_slip.regression.inference.drive_moments import ClusterUnit, DriveMoments
from fleet_slip.regression.inference.influential import Influential, find_influential
from fleet_slip.regression.validation.crossval import CrossValidation, least_squares
from fleet_slip.resources import find_config
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.warehouse.condition import Condition, parse_condition
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.tables import Warehouse

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


def influential_cars(served: Served, moments: DriveMoments) -> dict[str, Influential]:
    """Return cars of unusual influence by name, most unusual first. Raises `DataError` for few."""
    owners = np.array([name or "" for name in served.drives["vehicle_id"].to_pylist()])
    names, cars = np.unique(owners, return_inverse=True)
    found = find_influential(moments, cars.astype(np.int64))
    return {str(names[one.car]): one for one in found if names[one.car]}


def without_vehicles(condition: Condition, vehicles: Collection[str]) -> Condition:
    """Return a condition without some cars."""
    if not vehicles:
        return condition
    quoted = ", ".join(map(sql_text, sorted(vehicles)))
    others = f"(vehicle_id IS NULL OR vehicle_id NOT IN ({quoted}))"
    return parse_condition(f"{condition.sql} AND {others}")


def label_noise_deg(warehouse: Warehouse, cohort: CohortOrigin) -> float | None:
    """Return the standard deviation of the label's noise, of all rows of a cohort together.

    The step of its counts is part of it, as the standard deviation of a uniform error. None where
    no campaign states it.
    """
    if not warehouse.logs.snapshot().rows:  # all rows are of messages: none is read for this
        return None
    with open_grams(warehouse, cohort.feature_set, cohort.condition) as opened:
        rows = opened.label_sources(cohort.condition)
    stated = [(n, _stated_rad(source, campaign)) for source, campaign, n in rows]
    total = sum(n for n, _ in stated)
    if not total or any(std is None for _, std in stated):
        return None
    variance = sum(n * std**2 for n, std in stated if std is not None) / total
    step = float(catalogue()[catalogue().label].scale)
    return math.degrees(math.sqrt(variance + step**2 / 12))


def _stated_rad(source: str, campaign: str | None) -> float | None:
    """Return the noise that a campaign states; None of measured drives and unknown campaigns."""
    if source != "simulated" or campaign is None:
        return None
    try:
        content = load_toml(find_config("campaigns", campaign))
        if "sensors" not in content:
            content = load_toml(find_config("campaigns", content["base"]))
        return float(content["sensors"]["sideslip_std_rad"])
    except (ConfigError, KeyError):  # its file was elsewhere
        return None
