"""Before a selection: the first-stage model of a stacked list, and missing Gram rows."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.catalog.catalog import FirstStageModel, integer_combination
from fleet_slip.catalog.definitions import Combination, Definition
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohort import assign_folds, hash_names, load_cohort
from fleet_slip.grams.update import ensure_grams
from fleet_slip.models.request import (
    DEFAULT_MODELS,
    SelectionPlan,
    SelectionRequest,
    load_model_list,
)
from fleet_slip.models.select import select_models
from fleet_slip.regression.folds import CohortFolds
from fleet_slip.regression.least_squares import LinearModel, fit
from fleet_slip.storage.runs import recorded_step
from fleet_slip.warehouse.warehouse import Warehouse

FOLDS = 8
"""Folds of a first-stage model: its estimate on a drive is that of the fit without its fold."""

DEFAULT_LIST_ROWS = 4_000_000
"""Maximum number of log rows to reduce for the default model list, which takes seconds."""

MAX_GROWTH = 2
"""A first-stage model is fitted again if the cohort has this many times its drives."""

About = dict[str, Any]
"""Content of a `FirstStageModel`: `estimate`, `scale`, `models`, their checksum, set and cohort."""


def ensure_rows(
    warehouse: Warehouse, plan: SelectionPlan, cohort: str, predicate: str
) -> SelectionPlan:
    """Compute the Gram rows that a plan lacks; fit the first-stage model of its list if needed.

    `predicate` is the `cohort` without faulty drives. Returns the plan on the feature set that has
    the estimate of the first-stage model. Raises as `run_plan`.
    """
    catalog = warehouse.catalog
    if catalog.stacked_sets.get(plan.feature_set):
        model = _first_stage_model(warehouse, plan, cohort, predicate)
        name = f"{plan.feature_set}_{model.digest}"
        plan = replace(plan, feature_set=name, original=replace(plan.original, features=name))
    if catalog.first_stage_model(plan.feature_set):
        reason = "they contain the first-stage estimate"
        ensure_grams(warehouse, plan.feature_set, predicate, reason=reason)
    if plan.request.models == DEFAULT_MODELS:
        reason = f"model list {DEFAULT_MODELS} needs them"
        ensure_grams(
            warehouse, plan.feature_set, predicate, reason=reason, max_rows=DEFAULT_LIST_ROWS
        )
    return plan


def _first_stage_model(
    warehouse: Warehouse, plan: SelectionPlan, cohort: str, predicate: str
) -> FirstStageModel:
    """Return the stored first-stage model of a plan's list, or fit and store one."""
    catalog, name = warehouse.catalog, plan.feature_set
    line = plan.candidate_list.line if plan.candidate_list else None
    if line is None:
        raise QuestionError(
            f"the feature set {name} contains the estimate of a first-stage model: choose a model "
            "list that names it (line), such as models = learning."
        )
    models = load_model_list(catalog, line)
    estimate = catalog.stacked_sets[name]
    about = {
        "estimate": estimate,
        "scale": catalog.estimates[estimate].scale,
        "models": line,
        "models_sha256": models.sha256,
        "feature_set": catalog.identity(models.features),
        "cohort": cohort,
    }
    if model := _stored_model(warehouse, about, predicate):
        return model
    with recorded_step(warehouse.root, "fit_first_stage_model", [str(about["models"])]):
        model = _fit_first_stage(warehouse, about, predicate)
        warehouse.stacked_models.keep(model)
    return model


def _stored_model(warehouse: Warehouse, about: About, predicate: str) -> FirstStageModel | None:
    """Return the stored model with the most drives, all in the cohort; None if it has too few."""
    models = warehouse.stacked_models
    stored = [model for digest in models.digests() if (model := models.find(digest))]
    cohort_drives = load_cohort(warehouse, predicate).hash_drives_with(())

    def matches(model: FirstStageModel) -> bool:
        drives = np.frombuffer(bytes.fromhex(model.drive_hashes), dtype=">u8").astype(np.uint64)
        return about.items() <= vars(model).items() and bool(np.isin(drives, cohort_drives).all())

    candidates = filter(matches, stored)
    best = max(candidates, key=lambda model: (model.drives, model.digest), default=None)
    return best if best and len(cohort_drives) < MAX_GROWTH * best.drives else None


def _fit_first_stage(warehouse: Warehouse, about: About, predicate: str) -> FirstStageModel:
    """Choose a model from its list; fit it to all drives, and without each fold.

    Raises as `run_plan`, and `QuestionError` if its estimate would not be exact.
    """
    catalog = warehouse.catalog
    plan = SelectionPlan.from_request(
        catalog, SelectionRequest(models=about["models"], group_by="drive")
    )
    reason = f"model list {about['models']} fits the first-stage model on them"
    ensure_grams(warehouse, plan.feature_set, predicate, reason=reason)
    cohort = load_cohort(warehouse, predicate, plan.feature_set)
    signals, label = select_models(cohort, plan).winner.model.signals, catalog.signals.label
    served = cohort.complete_cases(signals)
    drives = served.drives["drive_id"].to_pylist()
    hashed = FOLDS if len(set(drives)) > FOLDS else None
    assignment = assign_folds(drives, "drive", FOLDS)
    folds = CohortFolds.from_tables([served.table], assignment).complete_cases(signals, label)
    unit = catalog.input_scales[label] / Fraction(about["scale"])
    columns = [
        catalog.definition(name) or catalog.rows([name]).get(name) or Definition(of=name)
        for name in signals
    ]

    def to_counts(model: LinearModel) -> Combination:
        slopes = [slope * unit for slope in model.coefficients]
        return integer_combination(model.intercept * unit, slopes, columns)

    return FirstStageModel(
        **about,
        fitted=to_counts(fit(folds.total, signals, label).model),
        folds={
            fold: to_counts(fit(training, signals, label).model)
            for fold, (training, _) in zip(folds.names, folds.splits(), strict=True)
        },
        hashed=hashed,
        drives=len(set(drives)),
        drive_hashes=np.unique(hash_names(pa.array(drives))).astype(">u8").tobytes().hex(),
    )
