"""What columns over time are worth, and what a car's own numbers are."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveColumns, as_counts
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario, error_figures
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.folding import Folding, assign_folds
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.exact.figures import ErrorSums
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.validation.crossval import (
    CrossValidation,
    cross_validate_inputs,
    held_out_errors,
)
from fleet_slip.regression.validation.folds import CohortFolds
from fleet_slip.selection.model_list import Search
from fleet_slip.selection.search import SearchedModels, search_models
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ
from fleet_slip.views import connect
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.tables import Warehouse

DRIVES = ("nominal", "melbourne", "noise_doubled", "style_sporty")
"""Test drives whose errors stand beside the cross-validated one."""

THIS_SAMPLE = "this sample"
SINCE_START = "since the start"


@dataclass(frozen=True)
class Without:
    """The cross-validated RMSE of a model refitted without some columns, and how many they are."""

    name: str
    columns: int
    rmse_deg: float


@dataclass(frozen=True)
class Memory:
    """What memory buys a published model.

    Attributes:
        searched: models of 1, 2, ... columns that a search finds among all inputs of its set.
        on_drives: RMSE in deg of these models on test drives, by scenario, each shape (sizes,).
        rmse_deg: cross-validated, of the published model's columns as they stand. (The figure of a
            search is larger: there they are chosen again in every fold.)
        columns: without one of its columns, the dearest first.
        windows: without all columns of one length, from short to long.
    """

    searched: SearchedModels
    on_drives: Mapping[str, FloatArray]
    rmse_deg: float
    columns: tuple[Without, ...]
    windows: tuple[Without, ...]

    @property
    def cross_validated_deg(self) -> FloatArray:
        """Cross-validated RMSE of each size, shape (sizes,)."""
        return np.array([model.pooled.rmse_deg for model in self.searched.models])


def looks_back(manifest: Manifest) -> bool:
    """Return whether a model has columns over time."""
    return any(term.definition and term.definition.over for term in manifest.terms)


def weigh_memory(
    cohort: Cohort, manifest: Manifest, folding: Folding, runs: Mapping[str, EvaluatedScenario]
) -> Memory:
    """Weigh the columns of a published model, given the cohort with the Gram rows of its set."""
    search = Search(method="exchange", most=len(manifest.terms))  # as configs/models/estimator.toml
    searched = search_models(
        cohort, cohort.inputs, folding, search, intercept=not manifest.through_origin
    )
    folds = cohort.folds(folding.by, folding.count)
    whole = _refit(folds, manifest, manifest.signals)
    columns = _without(folds, manifest, {name: [name] for name in manifest.signals})
    return Memory(
        searched=searched,
        on_drives={
            name: _errors_on(runs[name], searched.models, cohort.feature_set)
            for name in DRIVES
            if name in runs
        },
        rmse_deg=whole.pooled.rmse_deg,
        columns=tuple(sorted(columns, key=lambda one: -one.rmse_deg)),
        windows=tuple(_without(folds, manifest, by_length(manifest))),
    )


def by_length(manifest: Manifest) -> dict[str, list[str]]:
    """Return the columns of each length of window, from short to long."""
    found: dict[float, list[str]] = {}
    for term in manifest.terms:
        one = term.definition
        ticks = one.ticks or np.inf if one and one.over else 0
        found.setdefault(ticks, []).append(term.signal)
    lengths = {0: THIS_SAMPLE, np.inf: SINCE_START}
    return {
        lengths.get(ticks, f"{ticks / SAMPLE_RATE_HZ:.2f} s"): found[ticks]
        for ticks in sorted(found)
    }


def _without(
    folds: CohortFolds, manifest: Manifest, groups: Mapping[str, Sequence[str]]
) -> Iterator[Without]:
    for name, left_out in groups.items():
        kept = [signal for signal in manifest.signals if signal not in left_out]
        if kept:
            yield Without(name, len(left_out), _refit(folds, manifest, kept).pooled.rmse_deg)


def _refit(folds: CohortFolds, manifest: Manifest, signals: Sequence[str]) -> CrossValidation:
    return cross_validate_inputs(
        "", folds, signals, catalogue().label, input_scales(), intercept=not manifest.through_origin
    )


def _errors_on(
    run: EvaluatedScenario, models: Sequence[CrossValidation], feature_set: str
) -> FloatArray:
    """Return the RMSE in deg of each model on a drive, from the columns that a car would have."""
    used = {name for model in models for name in model.signals}
    whole = ColumnPlan.of_set(features(), feature_set)
    names = tuple(name for name in whole.names if name in used)
    plan = ColumnPlan.of(
        names,
        {name: whole.rows[name] for name in names if name in whole.rows},
        {name: whole.windows[name] for name in names if name in whole.windows},
    )
    drive = run.drive
    columns = DriveColumns(plan, as_counts(drive.signals, plan.signals, drive.facts)).compute()
    physical = {
        name: column * float(input_scales()[name])
        for name, column in zip(names, columns, strict=True)
    }
    errors = []
    for model in models:
        weights = model.model.weights
        terms = [weight * physical[name] for name, weight in weights.items()]
        estimate = np.sum(terms, axis=0) + model.model.offset
        found = error_figures(estimate, drive.sideslip_rad, drive.evaluated).rmse_deg
        errors.append(np.nan if found is None else found)
    return np.array(errors)


SET = "fleet"
"""The feature set with the numbers that a car's own drives tell."""

FEWEST_CARS = 20
FOLDS = 10


@dataclass(frozen=True)
class Cars:
    """Errors in cars that the model was not fitted on, RMSE in degrees.

    Attributes:
        campaign: whose cars they are.
        before_deg, after_deg: of each car, without and with its own numbers, shape (cars,).
        all_before_deg, all_after_deg: of all rows together.
        inputs_before, inputs_after: number of inputs.
    """

    campaign: str
    before_deg: FloatArray
    after_deg: FloatArray
    all_before_deg: float
    all_after_deg: float
    inputs_before: int
    inputs_after: int


def weigh_cars(warehouse: Warehouse) -> Cars | None:
    """Weigh the numbers of the campaign with most cars; None without a fleet's Gram rows."""
    campaign = largest_fleet(warehouse)
    if campaign is None:
        return None
    one = features().feature_set(SET)
    try:
        cohort = load_cohort(
            warehouse, f"{TRAINING_DRIVES} AND campaign = {sql_text(campaign)}", SET
        )
        known = [name for name in one.inputs if name in cohort.inputs]
        before = [name for name in known if name not in {*one.calibrated, *features().factors}]
        own = [name for name in one.calibrated if name in known]
        if not own:  # no Gram rows of the set that numbers come from
            return None
        without, of_all = errors_by_car(cohort, before)
        with_own, of_all_with = errors_by_car(cohort, [*before, *own])
    except DataError:  # no Gram rows of the set, or cars that lack what it needs
        return None
    cars = sorted(set(without) & set(with_own), key=lambda car: without[car])
    return Cars(
        campaign=campaign,
        before_deg=np.array([without[car] for car in cars]),
        after_deg=np.array([with_own[car] for car in cars]),
        all_before_deg=of_all,
        all_after_deg=of_all_with,
        inputs_before=len(before),
        inputs_after=len(before) + len(own),
    )


def largest_fleet(warehouse: Warehouse) -> str | None:
    """Return the campaign with most cars, if they are enough for folds of cars."""
    with connect(warehouse.root) as database:
        found = database.execute(
            "SELECT campaign FROM drives WHERE campaign IS NOT NULL GROUP BY campaign "
            "HAVING count(DISTINCT vehicle_id) >= $fewest "
            "ORDER BY count(DISTINCT vehicle_id) DESC, campaign LIMIT 1",
            {"fewest": FEWEST_CARS},
        ).fetchone()
    return None if found is None else str(found[0])


def errors_by_car(cohort: Cohort, inputs: Sequence[str]) -> tuple[dict[str, float], float]:
    """Return the RMSE in deg of each car and of all, by models of others. Raises `DataError`."""
    label = catalogue().label
    served = cohort.serving(inputs)
    vehicles = served.drives["vehicle_id"].to_pylist()
    cars, number = np.unique(vehicles, return_inverse=True)
    folds = assign_folds(cars.tolist(), "vehicle", FOLDS)
    of_car = served.table.totals(number, len(cars))
    total = served.table.total()
    errors: dict[str, ErrorSums] = {}
    for fold in range(len(folds.names)):
        held_out = np.flatnonzero(folds.fold == fold)
        training = total - sum((of_car[i] for i in held_out[1:]), of_car[held_out[0]])
        model = fit(training, inputs, label).model
        errors |= {str(cars[i]): held_out_errors(model, training, of_car[i]) for i in held_out}
    unit = input_scales()[label]
    first, *others = errors.values()
    return (
        {car: one.figures(unit).rmse_deg for car, one in errors.items()},
        sum(others, first).figures(unit).rmse_deg,
    )
