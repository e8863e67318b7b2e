"""Model selection: complete cases, candidates, cross-validation, choice. Reads Gram rows only."""

import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.base import canonical_json, pluralize, sha256_of
from fleet_slip.calibration.course_label import assess_course_label
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError, DataError, NotComputedError, QuestionError
from fleet_slip.grams.cohort import (
    FOLD_KEYS,
    FULL_WEIGHT,
    PARTS,
    Cohort,
    CompleteCases,
    DownweightedDrive,
    Folding,
    age_weights,
    clustered_moments,
    load_cohort,
    robust_weights,
)
from fleet_slip.models.request import (
    DEFAULT_MODELS,
    GIVEN,
    LOGGED_MODELS,
    MAX_LISTED_INPUTS,
    WHOLE_SET,
    CandidateModel,
    ModelList,
    Search,
    SelectionPlan,
    SelectionRequest,
    checksum_of_list,
    even_columns,
    inputs_of,
    parse_tolerance,
)
from fleet_slip.models.summary import NestedErrors, SearchedModels, Selection, group_reasons
from fleet_slip.regression.choice import (
    Rule,
    Winner,
    best_correlated,
    choose,
    choose_nested,
    nested_fits,
)
from fleet_slip.regression.folds import (
    CohortFolds,
    CrossValidation,
    ErrorSums,
    Procedure,
    assemble,
    cross_validate,
    error_sums,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import DriveMoments
from fleet_slip.regression.least_squares import Fit, LinearModel, fit
from fleet_slip.regression.orders import stepwise_order
from fleet_slip.resources import Configs
from fleet_slip.warehouse.gram_reader import open_grams
from fleet_slip.warehouse.warehouse import Warehouse


def run_selection(
    warehouse: Warehouse, request: SelectionRequest, predicate: str = TRAINING_DRIVES
) -> Selection:
    """Validate a request and run it. Raises as `SelectionPlan.from_request` and `run_plan`."""
    return run_plan(warehouse, SelectionPlan.from_request(warehouse.catalog, request), predicate)


def run_plan(
    warehouse: Warehouse, plan: SelectionPlan, predicate: str, *, nested: bool = False
) -> Selection:
    """Select on the drives of a predicate. Raises as `load_cohort` and `select`.

    Compares the list of logged signals if the default list has no Gram rows. `nested` repeats the
    choice without the drives to test if the label is that of measured drives; for an order this is
    always done.
    """
    remark = ""
    try:
        cohort = load_training_set(warehouse, plan, predicate)
    except NotComputedError as error:
        if plan.original.models or plan.request.models != DEFAULT_MODELS:
            raise
        remark = f"Using model list {LOGGED_MODELS} instead of {DEFAULT_MODELS}: {error}"
        logged = replace(plan.original, models=LOGGED_MODELS)
        plan = replace(
            SelectionPlan.from_request(warehouse.catalog, logged), original=plan.original
        )
        cohort = load_training_set(warehouse, plan, predicate)
    selection = select_models(cohort, plan)
    rmse_deg = selection.winner.model.pooled.rmse_deg
    selected = selection.cohort
    quality = assess_course_label(warehouse, selected.feature_set, selected.predicate, rmse_deg)
    noise_deg = None if quality else label_noise_deg(warehouse, selected)
    has_measured_label = quality is None and noise_deg is None
    repeats_choice = plan.request.is_ordered or (nested and has_measured_label)
    return replace(
        selection,
        without_label=quality,
        label_noise_deg=noise_deg,
        remark=remark,
        requested_cohort=predicate,
        nested=cross_validate_choice(cohort, plan) if repeats_choice else None,
    )


# The noise of the label, which campaigns of simulated drives state.


def label_noise_deg(warehouse: Warehouse, cohort: Cohort) -> float | None:
    """Return the standard deviation of the label's noise over all rows of a cohort.

    It is part of every cross-validated error. The quantisation step counts as a uniform error.
    Returns None unless the campaigns of all rows state it in their `[sensors]`.
    """
    if not warehouse.logs.snapshot().rows:  # all Gram rows are from cars
        return None
    with open_grams(warehouse, cohort.feature_set, cohort.predicate) as opened:
        rows = opened.label_sources(cohort.predicate)
    stated = [(n, _stated_rad(source, campaign, warehouse.configs)) for source, campaign, n in rows]
    total = sum(n for n, _ in stated)
    if not total or any(std is None for _, std in stated):
        return None
    variance = sum(n * std**2 for n, std in stated if std is not None) / total
    signals = warehouse.catalog.signals
    step = float(signals[signals.label].scale)
    return math.degrees(math.sqrt(variance + step**2 / 12))


def _stated_rad(source: str, campaign: str | None, configs: Configs) -> float | None:
    """Return the noise that a campaign states; None for measured drives and unknown campaigns."""
    if source != "simulated" or campaign is None:
        return None
    try:
        content = load_toml(configs.find("campaigns", campaign))
        if "sensors" not in content:
            content = load_toml(configs.find("campaigns", content["base"]))
        return float(content["sensors"]["sideslip_std_rad"])
    except (ConfigError, KeyError):  # the configs do not contain its file
        return None


# Nested cross-validation: the folds that chose a winner understate its error.

MIN_DRIVES = 3
"""Minimum number of trips to hold out whole trips; with fewer, parts of the time are held out."""

MAX_HELD_OUT = 10
GROUPED = 8
"""Up to `MAX_HELD_OUT` trips are held out one by one; more are dealt into this number of groups."""

MAX_NESTED_DRIVES = 500
"""Maximum number of drives for which a choice is repeated; beyond it, the optimism is small."""


def deal_trips(trips: Sequence[str]) -> list[int]:
    """Return the group of each trip, to be held out together."""
    order = list(dict.fromkeys(trips))
    count = len(order) if len(order) <= MAX_HELD_OUT else GROUPED
    return [order.index(trip) % count for trip in trips]


def select_without(cohort: Cohort, plan: SelectionPlan, held_out: BoolArray) -> Selection:
    """Select as a plan does, without the Gram rows of a mask.

    Folds are trips where the key of the plan has a single value.
    """
    cohort = cohort.filter(~held_out)
    if len(cohort.drives[FOLD_KEYS[plan.folds.by]].unique()) < 2:
        folds, candidate_list = Folding(by="drive", count=plan.folds.count), plan.candidate_list
        candidate_list = candidate_list and candidate_list.model_copy(update={"folds": folds})
        plan = replace(plan, folds=folds, candidate_list=candidate_list)
    return select_models(cohort, plan)


def cross_validate_choice(cohort: Cohort, plan: SelectionPlan) -> NestedErrors | None:
    """Repeat a selection without each group of trips; return its errors on the held-out drives.

    Returns None if nothing is chosen, there are few trips or many drives, or a group cannot be held
    out.
    """
    if cohort.sums is not None and cohort.source is not None:
        if cohort.drive_count > MAX_NESTED_DRIVES:
            return None
        cohort = load_cohort(cohort.source, cohort.predicate, cohort.feature_set)
    groups = np.array(deal_trips(cohort.drives["trip"].to_pylist()))
    candidate_list = plan.candidate_list
    has_choice = candidate_list is None or candidate_list.search or len(candidate_list.model) > 1
    if len(np.unique(groups)) < MIN_DRIVES or not has_choice:
        return None
    errors: list[ErrorSums] = []
    for group in np.unique(groups):
        try:
            model = select_without(cohort, plan, groups == group).winner.model.counts
            test = cohort.filter(groups == group).complete_cases(model.signals)
        except (DataError, QuestionError):
            return None
        errors.append(error_sums(model, test.table.total()))
    unit = cohort.catalog.input_scales[cohort.catalog.signals.label]
    return NestedErrors(len(errors), sum(errors[1:], errors[0]).figures(unit))


def load_training_set(warehouse: Warehouse, plan: SelectionPlan, predicate: str) -> Cohort:
    """Read the Gram rows of a plan, and those of its prior; only the sums of folds if possible."""
    request = plan.request
    needs_drives = request.is_ordered or request.robust or request.half_life
    cohort = load_cohort(
        warehouse, predicate, plan.feature_set, None if needs_drives else plan.folds
    )
    if not request.prior:
        return cohort
    from fleet_slip.models.prior import simulate_prior  # noqa: PLC0415 - only here simulated

    prior = simulate_prior(warehouse.catalog, request.prior, plan.feature_set)
    return replace(cohort, prior=prior)


def select_models(cohort: Cohort, plan: SelectionPlan) -> Selection:
    """Weight the drives of a cohort, then compare the candidates of a plan. Raises as `select`."""
    weighted: dict[str, DownweightedDrive] = {}
    full = 1
    if plan.request.half_life:
        days = cohort.drives["day"].to_pylist()
        cohort, full = cohort.weighted(age_weights(days, plan.request.half_life)), FULL_WEIGHT
    if plan.request.robust:
        cohort, weighted = _downweight_outliers(cohort, plan)
        full *= FULL_WEIGHT if weighted else 1
    if plan.candidate_list is None:
        selection = _select_order(cohort, plan)
    else:
        selection = select(replace(cohort, prior=None), plan.candidate_list)
        if cohort.prior:
            selection = _join_prior(selection, cohort, cohort.prior)
        name = plan.request.models or GIVEN
        if plan.request.search:
            (search,) = plan.candidate_list.search
            name = f"search:{search.method} {search.max_features}"
        checksum = checksum_of_list(plan.candidate_list)
        selection = replace(selection, model_list=name, config_sha256=checksum)
    return replace(selection, weighted=weighted, full=full, request=plan.original)


def _downweight_outliers(
    cohort: Cohort, plan: SelectionPlan
) -> tuple[Cohort, dict[str, DownweightedDrive]]:
    """Down-weight the drives that are outliers of a model of all compared inputs."""
    candidates = (
        plan.candidate_list.model if plan.candidate_list and not plan.request.search else ()
    )
    signals = {name for candidate in candidates for name in candidate.signals}
    inputs = tuple(name for name in cohort.inputs if name in signals)
    inputs = inputs or inputs_of(cohort, plan.request.order or WHOLE_SET)
    intercept = plan.candidate_list.intercept if plan.candidate_list else plan.request.intercept
    outliers = outlier_drives(cohort.complete_cases(inputs), intercept=intercept)
    if not outliers:
        return cohort, {}
    weights = {name: round(outlier.weight * FULL_WEIGHT) for name, outlier in outliers.items()}
    names = cohort.drives["drive_id"].to_pylist()
    return cohort.weighted(np.array([weights.get(name, FULL_WEIGHT) for name in names])), outliers


def outlier_drives(cases: CompleteCases, *, intercept: bool) -> dict[str, DownweightedDrive]:
    """Return the drives that `robust` down-weights, the most unusual first."""
    table = cases.table if intercept else cases.table.about_origin()
    weights = robust_weights(DriveMoments.from_table(table))
    less = np.flatnonzero(weights.weights < FULL_WEIGHT).tolist()
    names = cases.drives["drive_id"].to_pylist()
    return {
        names[i]: weights.drive(i) for i in sorted(less, key=lambda i: -float(weights.times[i]))
    }


MAX_LOST_SHARE = Fraction(1, 10)
"""Maximum share of the drives that a candidate may exclude from the comparison."""


def select(cohort: Cohort, candidate_list: ModelList) -> Selection:
    """Cross-validate candidates and searches on the rows that all can use, and choose a winner.

    Skips, with the reason, candidates with absent or dependent signals or on too few drives, and
    searches that need more drives. Raises `DataError` if no candidate remains, or no drive has the
    label.
    """
    catalog, label, folds = (
        cohort.catalog,
        cohort.catalog.signals.label,
        folds_of(cohort, candidate_list),
    )
    if not folds.tables_with([label]):
        raise DataError(
            f"no drive of the cohort {cohort.predicate.quoted} has the label, {label}. Where cars "
            "log their course, learn from it: fleet-slip select --label course"
        )
    skipped: dict[str, str] = {}
    allowed, searches = _allow(cohort, candidate_list, skipped)
    columns = [name for name in cohort.inputs if any(search.among([name]) for search in searches)]
    shared, candidates, shared_columns = find_complete_cases(
        folds, label, allowed, columns, skipped
    )
    models = []
    for candidate in candidates:
        name, signals = candidate.name, candidate.signals
        try:
            models.append(_cross_validate(name, signals, shared, catalog))
        except DataError as error:
            skipped[name] = str(error)
    searched = []
    for search in searches:
        among = search.among(shared_columns)
        if rare := [name for name in search.among(columns) if name not in among]:
            skipped[f"{search.title} (columns)"] = (
                "not comparable: more than a tenth of the drives lack "
                f"{', '.join(rare[:MAX_LISTED_INPUTS])}"
            )
        if not among:
            continue
        try:
            searched.append(search_models(shared, among, catalog, search))
        except DataError as error:  # no drive, or not one in each fold, has all inputs
            skipped[f"{search.title} (search)"] = str(error)
    models += [model for search_result in searched for model in search_result.models]
    if not models:
        groups = [(", ".join(names), text.rstrip(".")) for names, text in group_reasons(skipped)]
        reasons = [text if len(groups) == 1 else f"{names}: {text}" for names, text in groups]
        raise DataError(f"no candidate model can be fitted: {'; '.join(reasons)}.")
    winner = choose_by(candidate_list, models)
    name, signals = winner.model.name, winner.model.signals
    is_listed = name in {candidate.name for candidate in candidates}
    if is_listed and len(folds.tables_with([*signals, label])) > len(shared.tables):
        winner = replace(winner, model=_cross_validate(name, signals, folds, catalog))
    return Selection(
        cohort, candidate_list, tuple(models), winner, skipped, searched=tuple(searched)
    )


def _allow(
    cohort: Cohort, candidate_list: ModelList, skipped: dict[str, str]
) -> tuple[list[CandidateModel], list[Search]]:
    """Return the candidates, and the searches with their limits, that a cohort permits.

    Adds the reasons of all others to `skipped`.
    """
    candidates, searches = list[CandidateModel](), list[Search]()
    for candidate in candidate_list.model:
        if reason := even_columns(cohort.catalog, candidate.signals, cohort.feature_set):
            skipped[candidate.name] = reason
        else:
            candidates.append(candidate)
    drives = cohort.drive_count
    for search in candidate_list.search:
        limit = search.max_features
        if search.max_features_per_drive and candidate_list.folds.by != PARTS:
            limit = min(limit, search.max_features_per_drive * drives)
        if drives >= search.min_drives:
            searches.append(search.model_copy(update={"max_features": limit}))
        else:
            reason = f"it needs {search.min_drives} drives, and there are {drives}"
            skipped[f"{search.title} (search)"] = reason
    return candidates, searches


def folds_of(cohort: Cohort, candidate_list: ModelList) -> CohortFolds:
    """Divide a cohort into the folds of a list, for models with its intercept."""
    folds = cohort.folds(candidate_list.folds.by, candidate_list.folds.count)
    return replace(folds, has_intercept=candidate_list.intercept)


def find_complete_cases(
    folds: CohortFolds,
    label: str,
    candidates: Sequence[CandidateModel],
    columns: Sequence[str],
    skipped: dict[str, str],
) -> tuple[CohortFolds, list[CandidateModel], list[str]]:
    """Return the rows that all comparable candidates and columns can use, and these two.

    Candidates, and then columns, join one by one, the most common first. One that would leave fewer
    than 1 - `MAX_LOST_SHARE` of the drives of the most common does not join; `skipped` gets the
    reason for a candidate.
    """

    def drives_with(signals: Collection[str]) -> int:
        tables = folds.tables_with([*signals, label])
        return folds.count_drives(tables) if tables else 0

    entries = [(candidate.name, frozenset(candidate.signals)) for candidate in candidates]
    entries += [(name, frozenset([name])) for name in columns]
    drives = [drives_with(signals) for _, signals in entries]
    total = max(drives, default=0)
    order = sorted(range(len(entries)), key=lambda i: (i >= len(candidates), -drives[i]))
    common: frozenset[str] = frozenset()
    comparable: set[int] = set()
    for i in order:
        name, signals = entries[i]
        remaining = drives_with(common | signals)
        if drives[i] and remaining >= total * (1 - MAX_LOST_SHARE):
            common |= signals
            comparable.add(i)
        elif i < len(candidates):
            names = sorted(signals)
            rare = [signal for signal in names if drives_with([signal]) < total] or names
            skipped[name] = (
                f"not comparable: {total - remaining:,} of {pluralize(total, 'drive')} lack "
                f"{', '.join(rare)}, and only a tenth may be left out"
            )
            if absent := [signal for signal in names if not drives_with([signal])]:
                skipped[name] = f"these drives lack {', '.join(absent)}."
    return (
        folds.with_signals([*common, label]),
        [candidate for i, candidate in enumerate(candidates) if i in comparable],
        [name for i, name in enumerate(columns, len(candidates)) if i in comparable],
    )


def _cross_validate(
    name: str, signals: Sequence[str], folds: CohortFolds, catalog: Catalog
) -> CrossValidation:
    """Cross-validate least squares on the rows that have the signals. Raises `DataError`."""
    label = catalog.signals.label
    complete = folds.complete_cases(signals, label)
    procedure = least_squares(signals, label)
    return cross_validate(name, complete, procedure, catalog.input_scales)


def search_models(
    shared: CohortFolds, inputs: Sequence[str], catalog: Catalog, search: Search
) -> SearchedModels:
    """Search among the inputs on the rows that have them all. Raises `DataError`.

    Folds without such a row are left out: a car that stands or creeps has no curvature.
    """
    label = catalog.signals.label
    folds = shared.complete_cases(inputs, label)

    def fits(gram: Gram) -> list[Fit]:
        sets = stepwise_order(gram, inputs, label, search.method, search.max_features)
        is_nested = all(sets[size][:-1] == sets[size - 1] for size in range(1, len(sets)))
        if sets and is_nested:
            return nested_fits(gram, sets[-1], label)[1:]
        return [fit(gram, signals, label) for signals in sets]

    chosen = fits(folds.total)
    tests: list[list[ErrorSums]] = [[] for _ in chosen]
    for training, fold in folds.splits():
        # A fold may find fewer sizes; the larger ones are dropped below.
        for sums, fitted in zip(tests, fits(training), strict=False):
            sums.append(held_out_errors(fitted.model, training, fold))
    models = tuple(
        assemble(f"{search.title} {fitted.size}", folds, sums, fitted.model, catalog.input_scales)
        for sums, fitted in zip(tests, chosen, strict=True)
        if len(sums) == len(folds.grams)
    )
    if not models:
        raise DataError("every input is constant or depends on others: there is nothing to choose.")
    return SearchedModels(search, tuple(inputs), models)


def search_procedure(label: str, searched: SearchedModels, size: int) -> Procedure:
    """Return a procedure that repeats a search for at most `size` columns."""

    def procedure(gram: Gram) -> LinearModel:
        sets = stepwise_order(gram, searched.inputs, label, searched.search.method, size)
        return fit(gram, sets[-1] if sets else (), label).model

    return procedure


def choose_by(candidate_list: ModelList, models: Sequence[CrossValidation]) -> Winner:
    """Return the winner by the tolerance of a list, else by the rule of its first search."""
    rule = (
        candidate_list.search[0].rule
        if candidate_list.search and not candidate_list.tolerance
        else "tolerance"
    )
    if rule == "tolerance":
        return choose(models, parse_tolerance(candidate_list.tolerance))
    if rule == "standard error":
        return choose(models, 0.0)
    best = best_correlated(models)
    reason = (
        f"Model {best.name} has the best cross-validated correlation, {best.correlation:.6f}, "
        f"which is the rule of its list; every fold repeated the search."
    )
    return Winner(best, best, reason)


PRIOR_SHARE = Fraction(1, 8)
"""Total weight of the rows of a prior, as a share of that of the cohort (docs/measured.md)."""


MAX_PRIOR_COST = 1 / 10
"""Largest increase of the RMSE on held-out drives with a prior, as a share: on five recordings of
real cars a good prior costs at most a twentieth (docs/measured.md)."""


def keeps_prior(with_prior: float, without: float, drives: int) -> bool:
    """Return True if the held-out RMSE with a prior is low enough to keep the prior.

    It may exceed the RMSE without a prior by `MAX_PRIOR_COST`, or by 1/n for n drives if that is
    less. Held-out drives resemble the training drives, and favour a model without a prior.
    """
    return with_prior <= without * (1 + min(MAX_PRIOR_COST, 1 / drives))


def _join_prior(selection: Selection, cohort: Cohort, prior: Cohort) -> Selection:
    """Fit all inputs with the prior (no search: the prior regularises); keep the better fit."""
    candidate_list = selection.candidate_list
    alone = selection.winner.model
    searched = next((search.inputs for search in candidate_list.search if search.inputs), ())
    signals = tuple(name for name in searched if name in cohort.inputs) or alone.signals
    share = PRIOR_SHARE * Fraction(cohort.rows, prior.rows)
    weighted = replace(cohort, weight=Fraction(2) ** round(math.log2(share)))
    joined = _cross_validate("prior", signals, folds_of(weighted, candidate_list), cohort.catalog)
    figures = (
        f"RMSE on held-out drives: {joined.pooled.rmse_deg:.4f} deg with the prior, each row with "
        f"the weight {weighted.weight}, {alone.pooled.rmse_deg:.4f} deg without."
    )
    if keeps_prior(joined.pooled.rmse, alone.pooled.rmse, cohort.drive_count):
        cohort, reason = weighted, f"The prior stays. {figures}"
        winner = replace(selection.winner, model=joined, reason=reason)
    else:
        cohort = replace(cohort, weight=Fraction(0))
        reason = f"{selection.winner.reason} The prior is not used. {figures}"
        winner = replace(selection.winner, reason=reason)
    return replace(selection, cohort=cohort, models=(*selection.models, joined), winner=winner)


def _select_order(cohort: Cohort, plan: SelectionPlan) -> Selection:
    """Rank the inputs of an order, and choose one of the nested models."""
    request, catalog = plan.request, cohort.catalog
    order = request.order or WHOLE_SET
    inputs, label = inputs_of(cohort, order), catalog.signals.label
    tolerance = parse_tolerance(request.tolerance)
    rule = Rule(request.ranking or "declared", request.criterion or "cv", tolerance)
    folds = replace(
        cohort.folds(plan.folds.by, plan.folds.count), has_intercept=request.intercept
    ).complete_cases(inputs, label)
    drives = clustered_moments(cohort.complete_cases(inputs), intercept=request.intercept)
    choice = choose_nested(folds, drives, inputs, label, catalog.input_scales, rule)
    name, signals = choice.winner.model.name, choice.winner.model.signals
    model_list = f"order:{order} {rule.ranking} {rule.criterion}"
    candidate_list = ModelList(
        description=f"Chosen by select: {model_list}",
        features=cohort.feature_set,
        folds=plan.folds,
        intercept=request.intercept,
        model=(CandidateModel(name=name, signals=signals),),
    )
    content = {"inputs": inputs, "rule": asdict(rule), "winner": candidate_list.sha256}
    return Selection(
        cohort,
        candidate_list,
        choice.models,
        choice.winner,
        {},
        choice=choice,
        model_list=model_list,
        config_sha256=sha256_of(canonical_json(content)),
    )
