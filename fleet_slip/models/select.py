"""Compares candidate models on a cohort by cross-validation and chooses one; no log row is read."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np

from fleet_slip.base import canonical_json, document_of, sha256_of
from fleet_slip.calibration.course_label import CourseLabelQuality, assess_course_label
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.drive_sources import TRAINING_DRIVES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import DataError, NotComputedError, QuestionError
from fleet_slip.grams.cohort import Cohort, CompleteCases, load_cohort
from fleet_slip.grams.drive_weights import FULL, DownweightedDrive, age_weights, robust_weights
from fleet_slip.grams.folding import PARTS, Folding, make_folding
from fleet_slip.models.label_noise import label_noise_deg
from fleet_slip.models.request import (
    COURSE_FEATURES,
    COURSE_MODELS,
    DEFAULT_MODELS,
    LOGGED_MODELS,
    WHOLE_SET,
    CandidateModel,
    ModelList,
    Search,
    SelectionRequest,
    inputs_of,
    load_model_list,
    name_inputs,
    nested_candidates,
    parse_tolerance,
    require_inputs,
    require_odd,
)
from fleet_slip.models.search import (
    ALL_SUBSETS,
    SearchChoice,
    SearchedModels,
    choose_by,
    require_criterion,
    search_models,
    select_inputs,
    try_distances,
)
from fleet_slip.models.summary import summarize
from fleet_slip.regression.choice import NestedDistances, Rule, Tolerance, Winner
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.folds import (
    CrossValidation,
    cross_validate,
    cross_validate_inputs,
    least_squares,
)
from fleet_slip.regression.orders import METHODS
from fleet_slip.rendering import Answer, Part
from fleet_slip.warehouse.warehouse import Warehouse


def outlier_drives(served: CompleteCases, *, intercept: bool) -> dict[str, DownweightedDrive]:
    """Return the drives that `robust` counts less, the most unusual first."""
    table = served.table if intercept else served.table.about_origin()
    weights = robust_weights(DriveMoments.from_table(table), intercept=intercept)
    less = np.flatnonzero(weights.weights < FULL).tolist()
    names = served.drives["drive_id"].to_pylist()
    return {
        names[i]: weights.drive(i) for i in sorted(less, key=lambda i: -float(weights.times[i]))
    }


@dataclass(frozen=True)
class Selection(Answer):
    """All candidates with their figures, in the order of the list, and the winner.

    Attributes:
        skipped: candidates that the cohort cannot serve, with the reason.
        choice: how an order or a subset was chosen; None for a list of models.
        searched: the models of each search, which are among `models`.
        distances: of an order's nested models from the full and the true one, or why not told.
        intercept: whether models have one; without it they go through the origin.
        model_list, config_sha256: what was compared, such as `table1`, and its checksum.
        weighed: the drives that `robust` counts less than others, the most unusual first.
        full: how many times a row of full weight counts.
        without_label: how good the winner is, if changes of the course alone trained it.
        label_noise_deg: of the label, which every error has in it; None where it is not known.
        request, asked_condition: what was asked for, and of which drives.
        remark: why another list than the usual one was compared.
        examined: which drives were left out for faulty sensors, as a sentence.
    """

    cohort: Cohort
    folds: Folding
    models: tuple[CrossValidation, ...]
    winner: Winner
    skipped: dict[str, str]
    choice: SearchChoice | None = None
    searched: tuple[SearchedModels, ...] = ()
    distances: NestedDistances | str | None = None
    intercept: bool = True
    model_list: str = ""
    config_sha256: str = ""
    weighted: Mapping[str, DownweightedDrive] = field(default_factory=dict)
    full: int = 1
    without_label: CourseLabelQuality | None = None
    label_noise_deg: float | None = None
    request: SelectionRequest = field(default_factory=SelectionRequest)
    asked_condition: str = TRAINING_DRIVES
    remark: str = ""
    examined: str = ""

    def __repr__(self) -> str:
        winner = self.winner.model
        return (
            f"<{type(self).__name__}: {winner.name}, {len(winner.signals)} signals, RMSE "
            f"{winner.pooled.rmse_deg:.4f} deg, correlation {winner.correlation:.4f}, of "
            f"{len(self.models)} models; {self.cohort.drive_count:,} drives where "
            f"{self.cohort.predicate.text}>"
        )

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Return the winner and why, the best models or all, and how sure that is."""
        return summarize(self, everything)

    @property
    def searched_winner(self) -> SearchedModels | None:
        """The search that found the winner, if one did."""
        signals = self.winner.model.signals
        of_search = (s for s in self.searched if signals in [one.signals for one in s.models])
        return next(of_search, None)

    @property
    def rows_without(self) -> int:
        """Rows of the cohort that tell nothing of the winner: the label or a column is missing."""
        return max(self.cohort.rows - self.trained_rows, 0)

    @property
    def trained_rows(self) -> int:
        """Rows that the winner was trained on; of drives that count less, so much of them."""
        return self.winner.model.pooled.rows // self.full

    @property
    def beyond_label_noise_deg(self) -> float | None:
        """The winner's RMSE without the label's noise."""
        if self.label_noise_deg is None:
            return None
        rmse_deg = self.winner.model.pooled.rmse_deg
        return math.sqrt(max(rmse_deg**2 - self.label_noise_deg**2, 0.0))

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        document: dict[str, Any] = {
            "models": [
                {**model.as_dict(), "gram_rows": self.cohort.gram_condition(model.signals)}
                for model in self.models
            ],
            "winner": self.winner.model.name,
            "reason": self.winner.reason,
            "cohort": self.cohort.predicate.text,
            "feature_set": self.cohort.catalog.identity(self.cohort.feature_set),
            "drives": self.cohort.drive_count,
            "rows": self.cohort.rows,
            "rows_without": self.rows_without,
            "drives_without_log": self.cohort.count_onboard_with(),
            "drives_left_out": self.cohort.left_out,
            "intercept": self.intercept,
            "folds": {
                "by": self.folds.by,
                "count": len(self.models[0].folds),
            },
            "skipped": self.skipped,
            "drives_weighed": document_of(self.weighted),
            "label_noise_deg": self.label_noise_deg,
        }
        for model, shortfall in zip(document["models"], self.winner.gaps, strict=False):
            model["shortfall"] = shortfall.as_dict()
        nested = {"left_out": self.distances} if isinstance(self.distances, str) else self.distances
        found = {
            "choice": self.choice,
            "search": self.searched_winner or next(iter(self.searched), None),
            "nested": nested,
            "without_label": self.without_label,
            "remark": self.remark,
            "examined": self.examined,
        }
        if self.cohort.prior:
            found["prior"] = {
                "campaign": str(self.request.prior),
                "weight": str(self.cohort.weight),
            }
        document |= {name: document_of(one) for name, one in found.items() if one}
        return document


def select(
    cohort: Cohort,
    candidates: Sequence[CandidateModel],
    folds: Folding,
    tolerance: Tolerance | None = None,
    searches: Sequence[Search] = (),
    inputs: Sequence[str] = (),
    *,
    intercept: bool = True,
) -> Selection:
    """Cross-validate each candidate, and what searches find among inputs; choose the winner.

    `tolerance` overrides the rule of the first search. Skips candidates with absent or dependent
    signals, and searches that need more drives. Raises `DataError` if none is left, or no drive has
    the label.
    """
    divided = cohort.folds(folds.by, folds.count)
    catalog = cohort.catalog
    label = catalog.signals.label
    if not any(label in grams[0].signals for grams in divided.tables):
        raise DataError(
            f"no drive of the cohort {cohort.predicate.quoted} has the label, {label}. Where cars "
            "log their course, learn from it: fleet-slip select --label course"
        )
    models: list[CrossValidation] = []
    skipped: dict[str, str] = {}
    scales = catalog.input_scales
    for one in candidates:
        try:
            require_odd(catalog, one.signals, cohort.feature_set)
            models.append(
                cross_validate_inputs(
                    one.name, divided, one.signals, label, scales, intercept=intercept
                )
            )
        except (DataError, QuestionError) as error:
            skipped[one.name] = str(error)
    searched: list[SearchedModels] = []
    for search in searches:
        if cohort.drive_count < search.min_drives:
            few = f"it needs {search.min_drives} drives, and there are {cohort.drive_count}"
            skipped[f"{search.name or search.method} (search)"] = few
        elif among := search.among(inputs):
            most = search.max_features
            if search.max_features_per_drive and folds.by != PARTS:
                most = min(most, search.max_features_per_drive * cohort.drive_count)
            bounded = search.model_copy(update={"max_features": most})
            try:
                found = search_models(cohort, among, folds, bounded, intercept=intercept)
            except DataError as error:  # no drive, or not one in each fold, has all inputs
                skipped[f"{search.name or search.method} (search)"] = str(error)
            else:
                searched.append(found)
                models += found.models
    if not models:
        reasons = "; ".join(f"model {name}: {reason}" for name, reason in skipped.items())
        raise DataError(f"no candidate model can be fitted: {reasons}")
    winner = choose_by(searches[0] if searches else None, models, tolerance)
    return Selection(
        cohort,
        folds,
        tuple(models),
        winner,
        skipped,
        searched=tuple(searched),
        intercept=intercept,
    )


GIVEN = "given"
"""The name of a model whose inputs were asked for one by one."""


def run_selection(
    warehouse: Warehouse, request: SelectionRequest, predicate: str = TRAINING_DRIVES
) -> Selection:
    """Select on a predicate's drives, without the columns of the usual list by that of signals.

    Raises `UsageError` for options that do not go together.
    """
    catalog, remark = warehouse.catalog, ""
    plan = SelectionPlan.of(catalog, request)
    usual = not request.models and plan.request.models == DEFAULT_MODELS
    try:
        answer = _answer(warehouse, plan, predicate)
    except NotComputedError as error:
        if not usual:
            raise
        remark = f"Using model list {LOGGED_MODELS} instead of {DEFAULT_MODELS}: {error}"
        plan = SelectionPlan.of(catalog, replace(request, models=LOGGED_MODELS))
        answer = _answer(warehouse, plan, predicate)
    cohort, error_deg = answer.cohort, answer.winner.model.pooled.rmse_deg
    told = assess_course_label(warehouse, cohort.feature_set, cohort.predicate, error_deg)
    noise_deg = None if told else label_noise_deg(warehouse, answer.cohort)
    known = replace(answer, without_label=told, label_noise_deg=noise_deg, remark=remark)
    return replace(known, request=request, asked_condition=predicate)


@dataclass(frozen=True)
class SelectionPlan:
    """What a request compares: its list, which `request` names, its folds and its feature set."""

    request: SelectionRequest
    model_list: ModelList | None
    folds: Folding
    feature_set: str

    @classmethod
    def of(cls, catalog: Catalog, request: SelectionRequest) -> "SelectionPlan":
        """Return what a request asks for. Raises `UsageError` and `QuestionError`."""
        request.check()
        by_inputs = request.order or request.is_ordered or request.search
        if not (request.models or request.model or by_inputs):
            logged = request.features or request.group_by == PARTS
            usual = LOGGED_MODELS if logged else DEFAULT_MODELS
            request = replace(request, models=COURSE_MODELS if request.label else usual)
        model_list = _given(catalog, request)
        if request.models:
            model_list = load_model_list(catalog, request.models)
        if model_list and model_list.label and not request.label:
            request = replace(request, label=model_list.label)
            request.check()
        listed = model_list.folds if model_list else Folding()
        folds = make_folding(request.group_by or listed.by, request.folds, listed.count)
        return cls(request, model_list, folds, _feature_set(catalog, request, model_list))

    def choose(self, cohort: Cohort) -> Selection:
        """Compare and choose on a cohort, whatever drives it is of. Raises as `select`."""
        weighted: dict[str, DownweightedDrive] = {}
        full = 1
        if self.request.half_life:
            days = cohort.drives["day"].to_pylist()
            cohort, full = cohort.weighted(age_weights(days, self.request.half_life)), FULL
        if self.request.robust:
            cohort, weighted = _weigh_drives(cohort, self)
            full *= FULL if weighted else 1
        if prior := cohort.prior:
            found = weigh_prior(cohort, prior, self)
        elif self.request.is_ordered:
            found = _search(cohort, self.request, self.folds)
        else:
            found = _compare_listed(cohort, self.request, self.model_list, self.folds)
        return replace(found, weighted=weighted, full=full)


def _answer(warehouse: Warehouse, plan: SelectionPlan, predicate: str) -> Selection:
    request, folds = plan.request, plan.folds
    distances = bool(
        request.order and not request.is_ordered and not _searches_of(request, plan.model_list)
    )
    of_drives = request.is_ordered or request.robust or request.half_life
    whole = of_drives or distances  # else the sum of each fold suffices
    cohort = load_cohort(warehouse, predicate, plan.feature_set, None if whole else folds)
    if request.prior:
        from fleet_slip.models.prior import simulate_prior  # noqa: PLC0415 - only here simulated

        prior = simulate_prior(warehouse.catalog, request.prior, plan.feature_set)
        cohort = replace(cohort, prior=prior)
    answer = plan.choose(cohort)
    if distances:
        inputs = inputs_of(answer.cohort, request.order or WHOLE_SET)
        told = try_distances(answer.cohort, inputs, folds, request)
        answer = replace(answer, distances=told)
    return answer


PRIOR_SHARE = Fraction(1, 8)
"""Weight of all rows of a prior together, where those of the cohort have 1 (docs/measured.md)."""


def weigh_prior(cohort: Cohort, prior: Cohort, plan: SelectionPlan) -> Selection:
    """Fit the columns of a list's first search to the cohort and its prior, or choose without it.

    With a prior nothing is searched for: simulated drives tell what real ones leave open, so all
    columns can stay. Held-out drives are driven as the others are, and flatter what is chosen on
    few of them: of n drives the choice without the prior must be better by more than 1/n.
    """
    alone = replace(cohort, prior=None)
    first = _compare_listed(alone, plan.request, plan.model_list, plan.folds)
    winner, label = first.winner.model, cohort.catalog.signals.label
    searches = _searches_of(plan.request, plan.model_list)
    named = next((one.inputs for one in searches if one.inputs), ())
    signals = tuple(name for name in named if name in cohort.inputs) or winner.signals
    share = PRIOR_SHARE * Fraction(cohort.rows, prior.rows)
    weighted = replace(cohort, weight=Fraction(2) ** round(math.log2(share)))
    folds = weighted.folds(plan.folds.by, plan.folds.count).complete_cases(
        signals, label, sparse=True
    )
    choose = least_squares(signals, label, intercept=plan.request.intercept)
    joined = cross_validate("prior", folds, choose, cohort.catalog.input_scales)
    told = (
        f"RMSE on held-out drives: {joined.pooled.rmse_deg:.4f} deg with the prior, each row with "
        f"the weight {weighted.weight}, {winner.pooled.rmse_deg:.4f} deg without."
    )
    models = (*first.models, joined)
    if joined.pooled.rmse > winner.pooled.rmse * (1 + 1 / cohort.drive_count):
        reason = f"{first.winner.reason} The prior is not used. {told}"
        chosen = replace(first.winner, reason=reason)
        unused = replace(cohort, weight=Fraction(0))
        return replace(first, cohort=unused, models=models, winner=chosen)
    reason = f"The prior stays. {told}"
    chosen = replace(first.winner, model=joined, reason=reason)
    return replace(first, cohort=weighted, models=models, winner=chosen)


def _weigh_drives(
    cohort: Cohort, plan: SelectionPlan
) -> tuple[Cohort, dict[str, DownweightedDrive]]:
    """Return a cohort whose lost drives count less, by a model of all compared inputs."""
    request, model_list = plan.request, plan.model_list
    inputs = inputs_of(cohort, request.order or WHOLE_SET)
    if model_list and model_list.model and not (request.order or request.search):
        listed = {name for one in model_list.model for name in one.signals}
        inputs = tuple(name for name in cohort.inputs if name in listed)
    lost = outlier_drives(cohort.complete_cases(inputs), intercept=request.intercept)
    if not lost:
        return cohort, {}
    of_drive = {name: round(one.weight * FULL) for name, one in lost.items()}
    parts = np.array([of_drive.get(name, FULL) for name in cohort.drives["drive_id"].to_pylist()])
    return cohort.weighted(parts), lost


def _given(catalog: Catalog, request: SelectionRequest) -> ModelList | None:
    if request.model is None:
        return None
    feature_set = request.features or (COURSE_FEATURES if request.label else PLAIN)
    signals = require_inputs(catalog, request.model.split(","), feature_set)
    model = CandidateModel(name=GIVEN, signals=signals)
    return ModelList(description="One model", features=feature_set, model=(model,))


def _feature_set(catalog: Catalog, request: SelectionRequest, model_list: ModelList | None) -> str:
    usual = COURSE_FEATURES if request.label else PLAIN
    named = request.features or (model_list.features if model_list else usual)
    if request.label and not catalog.feature_set(named).change_ticks:
        names = ", ".join(name for name, entry in catalog.sets.items() if entry.change_s)
        raise QuestionError(
            f"the feature set {named} has no changes of the course. Feature sets that have: "
            f"{names}."
        )
    inputs = catalog.feature_set(named).inputs
    if model_list and (absent := model_list.absent_from(inputs)):
        raise QuestionError(
            f"the feature set {named} lacks columns of {request.models}: "
            f"{name_inputs(catalog, absent)}. Take another one, or another list of models."
        )
    return named


def _compare_listed(
    cohort: Cohort,
    request: SelectionRequest,
    model_list: ModelList | None,
    folds: Folding,
) -> Selection:
    listed = model_list.model if model_list else ()
    searches = _searches_of(request, model_list)
    tolerance = None if request.tolerance is None else parse_tolerance(request.tolerance)
    inputs = inputs_of(cohort, request.order or WHOLE_SET) if searches else ()
    nested = (
        nested_candidates(inputs_of(cohort, request.order))
        if request.order and not searches
        else ()
    )
    candidates = (*listed, *nested)
    if candidates:
        described = ModelList(
            description=model_list.description if model_list else "Nested models of an order",
            features=cohort.feature_set,
            folds=folds,
            model=candidates,
            search=searches,
        )
        name = request.models or (GIVEN if request.model else None)
        label = "+".join(filter(None, [name, f"order:{request.order}" if nested else None]))
        compared = described.sha256
    else:
        (search,) = searches
        content = {
            "inputs": list(inputs),
            **search.as_dict(include={"method", "max_features", "rule"}),
        }
        label = f"search:{search.method} {search.max_features}"
        compared = sha256_of(canonical_json(content))
    found = select(
        cohort, candidates, folds, tolerance, searches, inputs, intercept=request.intercept
    )
    checksum = _checksum(compared, request.tolerance, request.intercept)
    return replace(found, model_list=label, config_sha256=checksum)


def checksum_of_list(model_list: ModelList, tolerance: str | None) -> str | None:
    """Return the `config_sha256` of a selection from a list, None for one that only searches."""
    return _checksum(model_list.sha256, tolerance, True) if model_list.model else None


def _checksum(compared: str, tolerance: str | None, intercept: bool) -> str:
    """Return the checksum of what is compared, and of what else is asked for and not usual."""
    unusual: dict[str, Any] = {}
    if tolerance is not None:
        unusual["worth"] = tolerance
    if not intercept:
        unusual["intercept"] = False
    return sha256_of(canonical_json({"compared": compared, **unusual})) if unusual else compared


def _searches_of(request: SelectionRequest, model_list: ModelList | None) -> tuple[Search, ...]:
    if request.search:
        if request.search not in METHODS:
            raise QuestionError(f"unknown search {request.search!r}. Known: {', '.join(METHODS)}.")
        options: dict[str, Any] = {"method": request.search}
        if request.max_features:
            options["max_features"] = request.max_features
        if request.label:
            # The noise of the course exceeds the gain of a column: compare correlations.
            options["rule"] = "best"
        return (Search.model_validate(options),)
    return model_list.search if model_list else ()


def _search(cohort: Cohort, request: SelectionRequest, folds: Folding) -> Selection:
    nested = request.order or WHOLE_SET
    inputs = inputs_of(cohort, nested)
    criterion = require_criterion(request.criterion or "cv")
    ranking = ALL_SUBSETS if request.all_subsets else request.ranking or "declared"
    rule = Rule(ranking, criterion, parse_tolerance(request.tolerance))
    found = select_inputs(cohort, inputs, folds, rule, request)
    described = ModelList(
        description="Inputs to choose from",
        features=cohort.feature_set,
        folds=folds,
        model=(CandidateModel(name="inputs", signals=inputs),),
    )
    content = {"inputs": described.sha256, "ranking": rule.ranking, "criterion": rule.criterion}
    content |= {"evidence": found.choice.evidence.kind}
    return Selection(
        cohort,
        folds,
        found.models,
        found.winner,
        {},
        choice=found.choice,
        intercept=request.intercept,
        model_list=f"order:{nested} {rule.ranking} {rule.criterion}",
        config_sha256=_checksum(
            sha256_of(canonical_json(content)), request.tolerance, request.intercept
        ),
    )
