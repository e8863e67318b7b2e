"""Searches for inputs: nested models of a ranking, best subsets, and stepwise searches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.base import Record
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohort import Cohort, Folding, drive_folds
from fleet_slip.models.request import Search, SelectionRequest
from fleet_slip.regression.choice import (
    CROSS_VALIDATION,
    DEFAULT_TOLERANCE,
    MIN_FOLDS,
    ZERO_TOLERANCE,
    NestedChoice,
    NestedDistances,
    Rule,
    Tolerance,
    Winner,
    choose,
    cross_validate_nested,
    cross_validate_selection,
    measure_distances,
    nested_fits,
    select_nested,
)
from fleet_slip.regression.folds import (
    CohortFolds,
    CrossValidation,
    ErrorSums,
    Procedure,
    assemble,
    held_out_errors,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import Evidence
from fleet_slip.regression.least_squares import Fit, LinearModel, Scales, fit
from fleet_slip.regression.orders import stepwise_order
from fleet_slip.regression.subsets import CRITERIA, SizeResult, best_subsets, pick_sizes

ALL_SUBSETS = "all-subsets"
"""Instead of a ranking: the best subset of every size."""


@dataclass(frozen=True)
class SearchChoice(Record):
    """Choice of a number of signals.

    Attributes
    ----------
    rule
        Ranking (or `ALL_SUBSETS`) and criterion.
    evidence
        Independent evidence behind the criterion.
    nested
        The ranked signals with the criterion's values; None for all subsets.
    subsets
        The best subsets of size 0, 1, ...; each criterion picks a size.
    honest
        Figures of the choice, repeated in every training fold; None for two folds.
    """

    DOCUMENT = (
        "ranking=rule.ranking criterion=rule.criterion evidence=evidence.kind "
        "effective_rows=evidence.rows *nested subsets? picks? honest?"
    )

    rule: Rule
    evidence: Evidence
    nested: NestedChoice | None = None
    subsets: tuple[SizeResult, ...] | None = None
    picks: dict[str, int] | None = None
    honest: CrossValidation | None = None


@dataclass(frozen=True)
class SearchResult:
    """The candidates of a ranking or of all subsets, the winner, and how it was chosen."""

    models: tuple[CrossValidation, ...]
    winner: Winner
    choice: SearchChoice


def require_criterion(name: str) -> str:
    """Return a criterion by its name, `cv` for cross-validation. Raises `QuestionError`."""
    if name == "cv":
        return CROSS_VALIDATION
    if name not in (*CRITERIA, CROSS_VALIDATION):
        criteria = ", ".join(("cv", *CRITERIA))
        raise QuestionError(f"unknown criterion {name!r}. Known criteria: {criteria}.")
    return name


def select_inputs(
    cohort: Cohort,
    inputs: Sequence[str],
    folding: Folding,
    rule: Rule,
    request: SelectionRequest,
) -> SearchResult:
    """Choose a nested model of a ranking, or one of the best subsets, on complete drives.

    Raises `DataError` without drives, for dependent inputs or if none is kept, and `QuestionError`
    for an unknown rule.
    """
    label = cohort.catalog.signals.label
    unit, intercept = request.cluster, request.intercept
    training, fold = drive_folds(cohort, inputs, folding, cluster=unit, intercept=intercept)
    if rule.ranking == ALL_SUBSETS:
        results = best_subsets(training.total, inputs, label)
        evidence = training.evidence(training.nested_fits(inputs, label))
        picks = pick_sizes(results, evidence)
        models = [
            training.cross_validate(f"best {result.best.size}", result.best.model.signals, label)
            for result in results[1:]
        ]
        choice = SearchChoice(rule, evidence, subsets=tuple(results), picks=picks)
        size = picks.get(rule.criterion, 0)
    else:
        chosen = select_nested(training, inputs, label, rule)
        models = cross_validate_nested(training, chosen.order, label)[1:]
        honest = None
        if len(training.folds.grams) >= MIN_FOLDS:
            honest = cross_validate_selection(
                "the choice itself", training, fold, inputs, label, rule
            )
        choice = SearchChoice(rule, chosen.evidence, nested=chosen, honest=honest)
        size = chosen.size
    by_folds = rule.criterion == CROSS_VALIDATION
    winner = choose(models, rule.tolerance) if by_folds else _winner(models, size, choice)
    return SearchResult(tuple(models), winner, choice)


def try_distances(
    cohort: Cohort, inputs: Sequence[str], folding: Folding, request: SelectionRequest
) -> NestedDistances | str:
    """Return the distances of the nested models of an order, or why there are none."""
    try:
        unit, intercept = request.cluster, request.intercept
        training, _ = drive_folds(cohort, inputs, folding, cluster=unit, intercept=intercept)
        return measure_distances(training, inputs, cohort.catalog.signals.label)
    except (DataError, QuestionError) as error:
        return str(error)


def _winner(models: Sequence[CrossValidation], size: int, choice: SearchChoice) -> Winner:
    """Return the model of the size that a criterion keeps. Raises `DataError` for size 0."""
    rule = choice.rule
    if size == 0:
        raise DataError(
            f"the criterion {rule.criterion} selects no signal: none is better than chance. Choose "
            "more drives, other signals, or the criterion cv."
        )
    best = max(models, key=lambda model: model.sums.signed_r_squared)
    among = "the best subsets" if rule.ranking == ALL_SUBSETS else f"the order by {rule.ranking}"
    reason = (
        f"{rule.criterion} keeps {size} of {len(models)} signals of {among}, with "
        f"{choice.evidence.kind} as independent."
    )
    return Winner(models[size - 1], best, reason)


@dataclass(frozen=True)
class SearchedModels:
    """Models of a search, of sizes 1, 2, ...; each training fold repeated the search."""

    search: Search
    inputs: tuple[str, ...]
    models: tuple[CrossValidation, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of a JSON document."""
        main = self.search.as_dict(include={"method", "max_features", "rule"})
        options = self.search.as_dict(exclude_defaults=True, exclude={"inputs"})
        return {**main, **options, "inputs": len(self.inputs), "sizes": len(self.models)}


def search_models(
    cohort: CohortFolds,
    inputs: Sequence[str],
    label: str,
    scales: Scales,
    search: Search,
    *,
    intercept: bool = True,
) -> SearchedModels:
    """Search among the inputs on the rows that have them all. Raises `DataError`.

    Folds without such a row are left out: a car that stands or creeps has no curvature.
    """
    folds = cohort.complete_cases(inputs, label, sparse=True)

    def fits(gram: Gram) -> list[Fit]:
        moments = gram if intercept else gram.about_origin()
        sets = stepwise_order(moments, inputs, label, search.method, search.max_features)
        is_nested = all(sets[size][:-1] == sets[size - 1] for size in range(1, len(sets)))
        if sets and is_nested:
            return nested_fits(moments, sets[-1], label)[1:]
        return [fit(moments, signals, label) for signals in sets]

    chosen = fits(folds.total)
    tests: list[list[ErrorSums]] = [[] for _ in chosen]
    for training, fold in folds.splits():
        for sums, fitted in zip(tests, fits(training), strict=False):
            sums.append(held_out_errors(fitted.model, training, fold))
    models = tuple(
        assemble(f"{search.title} {fitted.size}", folds, sums, fitted.model, scales)
        for sums, fitted in zip(tests, chosen, strict=True)
        if len(sums) == len(folds.grams)
    )
    if not models:
        raise DataError("every input is constant or depends on others: there is nothing to choose.")
    return SearchedModels(search, tuple(inputs), models)


def search_procedure(
    label: str, searched: SearchedModels, size: int, *, intercept: bool
) -> Procedure:
    """Return a procedure that repeats a search for at most `size` columns."""

    def procedure(gram: Gram) -> LinearModel:
        moments = gram if intercept else gram.about_origin()
        sets = stepwise_order(moments, searched.inputs, label, searched.search.method, size)
        return fit(moments, sets[-1] if sets else (), label).model

    return procedure


def choose_by(
    search: Search | None, models: Sequence[CrossValidation], tolerance: Tolerance | None = None
) -> Winner:
    """Return the winner by a tolerance if one is given, else by the rule of a search."""
    if search is None or search.rule == "tolerance" or tolerance is not None:
        return choose(models, tolerance or DEFAULT_TOLERANCE)
    if search.rule == "standard error":
        return choose(models, ZERO_TOLERANCE)
    best = max(models, key=lambda model: model.sums.signed_r_squared)
    reason = (
        f"Model {best.name} has the best cross-validated correlation, {best.correlation:.6f}, "
        f"which is the rule of its list; every fold repeated the search."
    )
    return Winner(best, best, reason)
