"""Answers a request: reads the Gram rows it needs, and selects among models."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import NotComputedError, QuestionError, UsageError
from fleet_slip.grams.cohorts.fold_sums import SummedCohort, sum_cohort
from fleet_slip.grams.cohorts.folding import EACH, PARTS, ROW_FOLDS, Folding, make_folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.grams.cohorts.taught_cohort import TaughtCohort, load_taught
from fleet_slip.grams.cohorts.training_folds import clustered_moments
from fleet_slip.regression.choice.nested_choice import Rule
from fleet_slip.regression.choice.stepwise import METHODS
from fleet_slip.regression.choice.winner import Worth, fall_short
from fleet_slip.regression.exact.figures import student_t_two_sided
from fleet_slip.regression.validation.crossval import CrossValidation
from fleet_slip.selection.model_list import (
    WHOLE_SET,
    CandidateModel,
    ModelList,
    Search,
    inputs_of,
    load_model_list,
    nested_candidates,
    require_inputs,
)
from fleet_slip.selection.request import (
    BOTH,
    COURSE,
    DEFAULT_MODELS,
    LOGGED_MODELS,
    SelectionRequest,
    parse_worth,
)
from fleet_slip.selection.search import (
    ALL_SUBSETS,
    require_criterion,
    select_inputs,
    try_distances,
)
from fleet_slip.selection.select_models import RequestedSelection, Selection, select
from fleet_slip.selection.uncertainty import (
    estimate_uncertainty,
    influential_cars,
    label_noise_deg,
    without_vehicles,
)
from fleet_slip.selection.without_label import without_label
from fleet_slip.warehouse.tables import Warehouse

GIVEN = "given"
"""The name of a model whose inputs were asked for one by one."""


def answer_request(
    warehouse: Warehouse, request: SelectionRequest, condition: str = TRAINING_DRIVES
) -> RequestedSelection:
    """Select on a condition's drives. Raises `UsageError` for options that do not go together."""
    usual = not (request.models or request.model or request.label or request.chosen_by_inputs)
    find = _answer_usual if usual else _answer
    answer = replace(find(warehouse, request, condition), request=request, asked=condition)
    if isinstance(answer.cohort, TaughtCohort):  # its figures are of the angle
        return answer
    told = without_label(warehouse, answer.cohort, answer.winner.model.pooled.rmse_deg)
    noise_deg = None if told else label_noise_deg(warehouse, answer.cohort)
    return replace(answer, without_label=told, label_noise_deg=noise_deg)


def _answer_usual(
    warehouse: Warehouse, request: SelectionRequest, condition: str
) -> RequestedSelection:
    """Select from the usual list, or from that of logged signals where it cannot be had."""
    logged = replace(request, models=LOGGED_MODELS)
    if request.features or request.by in (ROW_FOLDS, PARTS):
        return _answer(warehouse, logged, condition)
    why = "Gram rows that cars counted are of the logged signals alone."
    if warehouse.logs.snapshot().rows:
        try:
            return _answer(warehouse, replace(request, models=DEFAULT_MODELS), condition)
        except NotComputedError as error:
            why = str(error)
    remark = f"compared {LOGGED_MODELS}, not the usual list {DEFAULT_MODELS}: {why}"
    return replace(_answer(warehouse, logged, condition), remark=remark)


def _answer(warehouse: Warehouse, request: SelectionRequest, condition: str) -> RequestedSelection:
    request.check()
    name = request.models or (COURSE if request.label and not request.chosen_by_inputs else None)
    model_list = _given(request) or (load_model_list(name) if name else None)
    if model_list and model_list.label and not request.label:
        request = replace(request, label=model_list.label)
        request.check()
    folds = _folding(request, model_list)
    feature_set = _feature_set(request, model_list)
    if request.label == BOTH:
        folds = folds if request.by else folds.model_copy(update={"by": "vehicle"})
        taught = load_taught(warehouse, condition, feature_set, folds.by)
        return weigh(taught, request, model_list, folds)
    if request.robust:
        return _answer_without(warehouse, request, condition, model_list, feature_set)
    distances = bool(request.nested and not request.ordered and not _search_of(request, model_list))
    if not (request.ordered or request.resampled or distances):
        return _compare_listed(
            sum_cohort(warehouse, folds, condition, feature_set), request, model_list, folds
        )
    cohort = load_cohort(warehouse, condition, feature_set)
    answer = (
        _search(cohort, request, folds)
        if request.ordered
        else _compare_listed(cohort, request, model_list, folds)
    )
    if distances:
        inputs = inputs_of(cohort, request.nested or WHOLE_SET)
        answer = replace(answer, distances=try_distances(cohort, inputs, folds, request))
    if not request.resampled:
        return answer
    figures = estimate_uncertainty(cohort, answer.winner.model, folds, request)
    return replace(answer, uncertainty=figures)


WEIGHTS = tuple(Fraction(4) ** power for power in range(4, -5, -1))
"""Weights of a change of the course that are tried, where a row with the label has 1."""


def weigh(
    cohort: TaughtCohort,
    request: SelectionRequest,
    model_list: ModelList | None,
    folds: Folding,
) -> RequestedSelection:
    """Select with the weight of the course that serves held-out drives with the label best.

    Of those not worse for sure, by Student's t over the folds, the largest: few cars have a label.
    """
    found = [
        _compare_listed(replace(cohort, weight=weight), request, model_list, folds)
        for weight in WEIGHTS
    ]
    best = min((one.winner.model for one in found), key=lambda model: model.pooled.rmse)
    return next(one for one in found if _may_be_as_good(one.winner.model, best))


def _may_be_as_good(model: CrossValidation, best: CrossValidation) -> bool:
    """Whether a model's error is not larger than that of the best, with 95 %."""
    short = fall_short(model, best, Worth(0.0))
    if not short.rmse > 0 or not short.standard_error:
        return not short.rmse > 0
    return student_t_two_sided(short.rmse / short.standard_error, len(best.folds) - 1) > 0.05


def _answer_without(
    warehouse: Warehouse,
    request: SelectionRequest,
    condition: str,
    model_list: ModelList | None,
    feature_set: str,
) -> RequestedSelection:
    """Select without the cars whose influence on a model of all compared inputs is unusual."""
    cohort = load_cohort(warehouse, condition, feature_set)
    inputs = inputs_of(cohort, request.nested or WHOLE_SET)
    if model_list and model_list.model and not (request.nested or request.search):
        listed = {name for one in model_list.model for name in one.signals}
        inputs = tuple(name for name in cohort.inputs if name in listed)
    served = cohort.serving(inputs)
    left_out = influential_cars(served, clustered_moments(served, "drive"))
    others = without_vehicles(cohort.condition, left_out)
    answer = _answer(warehouse, replace(request, robust=False), others.text)
    return replace(answer, left_out=left_out)


def _given(request: SelectionRequest) -> ModelList | None:
    if request.model is None:
        return None
    feature_set = request.features or (COURSE if request.label else PLAIN)
    signals = require_inputs(request.model.split(","), feature_set)
    model = CandidateModel(name=GIVEN, signals=signals)
    return ModelList(description="One model", features=feature_set, model=(model,))


def _folding(request: SelectionRequest, model_list: ModelList | None) -> Folding:
    listed = model_list.folds if model_list else Folding()
    folding = make_folding(request.by or listed.by, request.folds, listed.count)
    if request.repeat and folding.count == EACH:
        raise UsageError("repeat deals the folds anew, and folds of each drive have one deal only.")
    return folding


def _feature_set(request: SelectionRequest, model_list: ModelList | None) -> str:
    usual = COURSE if request.label else PLAIN
    named = request.features or (model_list.features if model_list else usual)
    if request.label and not features().feature_set(named).change_ticks:
        known = ", ".join(name for name, one in features().sets.items() if one.change_ticks)
        raise QuestionError(
            f"the feature set {named} has no changes of the course. Feature sets that have: "
            f"{known}."
        )
    if request.by == ROW_FOLDS and named == PLAIN:
        return next(name for name, one in features().sets.items() if one.row_folds)
    return named


def _compare_listed(
    cohort: Cohort | SummedCohort,
    request: SelectionRequest,
    model_list: ModelList | None,
    folds: Folding,
) -> RequestedSelection:
    listed = model_list.model if model_list else ()
    search = _search_of(request, model_list)
    worth = None if request.worth is None else parse_worth(request.worth)
    inputs = inputs_of(cohort, request.nested or WHOLE_SET) if search else ()
    nested = (
        nested_candidates(inputs_of(cohort, request.nested))
        if request.nested and not search
        else ()
    )
    if search and not listed:
        selection = select(cohort, (), folds, worth, search, inputs, intercept=request.intercept)
        content = {"inputs": list(inputs), **search.model_dump()}
        label = f"search:{search.method} {search.most}"
        checksum = _checksum(sha256_of(canonical_json(content)), request.worth, request.intercept)
        return RequestedSelection.of(selection, label, checksum)
    described = ModelList(
        description=model_list.description if model_list else "Nested models of an order",
        features=cohort.feature_set,
        folds=folds,
        model=(*listed, *nested),
        search=search,
    )
    usual = GIVEN if request.model else request.label
    name = request.models or (usual if listed else None)
    label = "+".join(filter(None, [name, f"nested:{request.nested}" if nested else None]))
    selection = select(
        cohort, described.model, folds, worth, search, inputs, intercept=request.intercept
    )
    checksum = _checksum(described.sha256, request.worth, request.intercept)
    return RequestedSelection.of(selection, label, checksum)


def checksum_of_list(model_list: ModelList, worth: str | None) -> str | None:
    """Return the `config_sha256` of a selection from a list, None for one that only searches."""
    return _checksum(model_list.sha256, worth, True) if model_list.model else None


def _checksum(compared: str, worth: str | None, intercept: bool) -> str:
    """Return the checksum of what is compared, and of what else is asked for and not usual."""
    unusual: dict[str, Any] = {}
    if worth is not None:
        unusual["worth"] = worth
    if not intercept:
        unusual["intercept"] = False
    return sha256_of(canonical_json({"compared": compared, **unusual})) if unusual else compared


def _search_of(request: SelectionRequest, model_list: ModelList | None) -> Search | None:
    if request.search:
        if request.search not in METHODS:
            raise QuestionError(f"unknown search {request.search!r}. Known: {', '.join(METHODS)}.")
        asked = {"method": request.search, **({"most": request.most} if request.most else {})}
        if request.label:
            # The noise of the course hides in the error what a column is worth to the angle.
            asked["rule"] = "best"
        return Search.model_validate(asked)
    return model_list.search if model_list else None


def _search(cohort: Cohort, request: SelectionRequest, folds: Folding) -> RequestedSelection:
    nested = request.nested or WHOLE_SET
    inputs = inputs_of(cohort, nested)
    criterion = require_criterion(request.criterion or "cv")
    ranking = ALL_SUBSETS if request.all_subsets else request.rank or "declared"
    rule = Rule(ranking, criterion, parse_worth(request.worth))
    found = select_inputs(cohort, inputs, folds, rule, request)
    described = ModelList(
        description="Inputs to choose from",
        features=cohort.feature_set,
        folds=folds,
        model=(CandidateModel(name="inputs", signals=inputs),),
    )
    content = {"inputs": described.sha256, "ranking": rule.ranking, "criterion": rule.criterion}
    content |= {"evidence": found.choice.evidence.kind}
    selection = Selection(
        cohort,
        folds,
        found.models,
        found.winner,
        {},
        choice=found.choice,
        intercept=request.intercept,
    )
    label = f"nested:{nested} {rule.ranking} {rule.criterion}"
    checksum = _checksum(sha256_of(canonical_json(content)), request.worth, request.intercept)
    return RequestedSelection.of(selection, label, checksum)
