"""The inner line of a model list whose feature set has its estimate: fitted first, and kept."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.catalog.definitions import Combination, Definition
from fleet_slip.catalog.first_stage import FirstStageModel, integer_combination
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.folding import assign_folds
from fleet_slip.grams.gram_files import hash_names
from fleet_slip.grams.update import ensure_grams
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.select import SelectionPlan
from fleet_slip.regression.folds import CohortFolds
from fleet_slip.regression.least_squares import LinearModel, fit
from fleet_slip.storage.runs import recorded_step
from fleet_slip.warehouse.warehouse import Warehouse

FOLDS = 8

About = dict[str, Any]
"""Of a `FirstStageModel`: its `estimate`, `scale`, `models`, their checksum, set and cohort."""

KEPT_UNTIL = 2
"""A line is fitted again where a cohort has so many times the drives that it was fitted to."""


def with_line_fitted(
    warehouse: Warehouse, request: SelectionRequest, asked: str, predicate: str
) -> SelectionRequest:
    """Return a request of a set with a line, which is fitted if none is kept; others as they are.

    `asked` is the cohort, `predicate` what of it has no fault. The Gram rows of the set, and those
    that the line needs, are made. Raises as `run_selection`.
    """
    catalog = warehouse.catalog
    plan = SelectionPlan.of(catalog, request)
    named = plan.feature_set
    if estimate := catalog.stacked_sets.get(named):
        if plan.model_list is None or plan.model_list.line is None:
            raise QuestionError(
                f"the feature set {named} contains a line's estimate: choose a model list that "
                "defines the line, such as models = learning."
            )
        models = load_model_list(catalog, plan.model_list.line)
        about = {
            "estimate": estimate,
            "scale": catalog.estimates[estimate].scale,
            "models": plan.model_list.line,
            "models_sha256": models.sha256,
            "feature_set": catalog.identity(models.features),
            "cohort": asked,
        }
        line = _kept_line(warehouse, about, predicate)
        if line is None:
            with recorded_step(warehouse.root, "fit_first_stage_model", [str(about["models"])]):
                line = fit_line(warehouse, about, predicate)
                warehouse.stacked_models.keep(line)
        named = f"{named}_{line.digest}"
        request = replace(request, features=named)
    if catalog.first_stage_model(named):
        ensure_grams(warehouse, named, predicate, reason="they contain the first-stage estimate")
    return request


def _kept_line(warehouse: Warehouse, about: About, predicate: str) -> FirstStageModel | None:
    """Return the line that was fitted to the most drives, all of which are there.

    None if there is none, or the cohort has outgrown it.
    """
    models = warehouse.stacked_models
    stored = [model for digest in models.digests() if (model := models.find(digest))]
    there = load_cohort(warehouse, predicate).hash_drives_with(())

    def fits(line: FirstStageModel) -> bool:
        drives = np.frombuffer(bytes.fromhex(line.drive_hashes), dtype=">u8").astype(np.uint64)
        return about.items() <= vars(line).items() and bool(np.isin(drives, there).all())

    best = max(filter(fits, stored), key=lambda line: (line.drives, line.digest), default=None)
    return best if best and len(there) < KEPT_UNTIL * best.drives else None


def fit_line(warehouse: Warehouse, about: About, predicate: str) -> FirstStageModel:
    """Choose a line from its model list, and fit it to all drives, and without each fold.

    Raises as `run_selection`, and `QuestionError` if its estimate would not be exact.
    """
    catalog = warehouse.catalog
    plan = SelectionPlan.of(catalog, SelectionRequest(models=about["models"], group_by="drive"))
    reason = f"model list {about['models']} fits the first-stage model on them"
    ensure_grams(warehouse, plan.feature_set, predicate, reason=reason)
    cohort = load_cohort(warehouse, predicate, plan.feature_set)
    signals, label = plan.choose(cohort).winner.model.signals, catalog.signals.label
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

    def whole(model: LinearModel) -> Combination:
        slopes = [slope * unit for slope in model.coefficients]
        return integer_combination(model.intercept * unit, slopes, columns)

    return FirstStageModel(
        **about,
        fitted=whole(fit(folds.total, signals, label).model),
        folds={
            fold: whole(fit(training, signals, label).model)
            for fold, (training, _) in zip(folds.names, folds.splits(), strict=True)
        },
        hashed=hashed,
        drives=len(set(drives)),
        drive_hashes=np.unique(hash_names(pa.array(drives))).astype(">u8").tobytes().hex(),
    )
