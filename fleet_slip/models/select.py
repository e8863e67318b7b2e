"""Model selection: complete cases, candidates, cross-validation, choice. Reads Gram rows only.

The functions stand in the order in which they run.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.base import Record, canonical_json, document_of, pluralize, sha256_of
from fleet_slip.calibration.course_label import CourseLabelQuality, assess_course_label
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError, DataError, NotComputedError, QuestionError
from fleet_slip.grams.cohort import (
    FOLD_KEYS,
    FULL,
    PARTS,
    Cohort,
    CompleteCases,
    DownweightedDrive,
    Folding,
    age_weights,
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
    checksum_with_options,
    inputs_of,
    parse_tolerance,
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
from fleet_slip.models.summary import group_skipped, summarize
from fleet_slip.regression.choice import NestedDistances, Rule, Tolerance, Winner
from fleet_slip.regression.folds import (
    CohortFolds,
    CrossValidation,
    ErrorSums,
    Figures,
    cross_validate,
    error_sums,
    least_squares,
)
from fleet_slip.regression.inference import DriveMoments
from fleet_slip.rendering import Answer, Part
from fleet_slip.resources import Configs
from fleet_slip.warehouse.gram_reader import open_grams
from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class Selection(Answer):
    """All candidates with their figures, in the order of the list, and the winner.

    Attributes
    ----------
    models
        Figures on the rows that all candidates can use.
    winner
        The winner, fitted to all rows that it can use.
    skipped
        Candidates that were not compared, with the reason.
    choice
        Choice of an order or a subset; None for a list of models.
    searched
        The models of each search, which are among `models`.
    distances
        Of an order's nested models from the full and the true one, or why unknown.
    intercept
        False if models go through the origin.
    model_list, config_sha256
        Name of what was compared, such as `table1`, and its checksum.
    compared
        What was compared, as a model list.
    weighted
        The drives that `robust` down-weights, the most unusual first.
    full
        How many times a row of full weight counts.
    without_label
        How good the winner is, if changes of the course alone trained it.
    label_noise_deg
        Of the label, which every error has in it; None where it is not known.
    request, asked_condition
        What was asked for, and of which drives.
    remark
        Why another list than the usual one was compared.
    examined
        Which drives were left out for faulty sensors, as a sentence.
    nested
        Errors with the whole choice repeated without the drives to test; None if not computed.
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
    compared: ModelList | None = None
    weighted: Mapping[str, DownweightedDrive] = field(default_factory=dict)
    full: int = 1
    without_label: CourseLabelQuality | None = None
    label_noise_deg: float | None = None
    request: SelectionRequest = field(default_factory=SelectionRequest)
    asked_condition: str = TRAINING_DRIVES
    remark: str = ""
    examined: str = ""
    nested: "NestedErrors | None" = None

    def __repr__(self) -> str:
        winner = self.winner.model
        return (
            f"<{type(self).__name__}: {winner.name}, {len(winner.signals)} signals, RMSE "
            f"{winner.pooled.rmse_deg:.4f} deg, correlation {winner.correlation:.4f}, of "
            f"{len(self.models)} models; {self.cohort.drive_count:,} drives where "
            f"{self.cohort.predicate.text}>"
        )

    def parts(self, everything: bool = False, hint: str = "") -> Iterator[Part]:
        """Return the winner and why, the best models or all; `hint` is the option for all."""
        return summarize(self, everything, hint)

    @property
    def searched_winner(self) -> SearchedModels | None:
        """The search that found the winner, if one did."""
        signals = self.winner.model.signals
        of_search = (s for s in self.searched if signals in [model.signals for model in s.models])
        return next(of_search, None)

    def as_model_list(self) -> ModelList:
        """Return a model list whose selection on the same data has the same winner."""
        if self.choice is None and self.compared is not None:
            return self.compared
        winner = self.winner.model
        return ModelList(
            description=f"Chosen by select: {self.model_list}",
            features=self.cohort.feature_set,
            folds=self.folds,
            intercept=self.intercept,
            model=(CandidateModel(name=winner.name, signals=winner.signals),),
        )

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
        optional = {
            "choice": self.choice,
            "search": self.searched_winner or next(iter(self.searched), None),
            "nested": nested,
            "without_label": self.without_label,
            "remark": self.remark,
            "examined": self.examined,
            "nested_cross_validation": self.nested,
        }
        if self.cohort.prior:
            optional["prior"] = {
                "campaign": str(self.request.prior),
                "weight": str(self.cohort.weight),
            }
        document |= {name: document_of(value) for name, value in optional.items() if value}
        return document


def run_selection(
    warehouse: Warehouse, request: SelectionRequest, predicate: str = TRAINING_DRIVES
) -> Selection:
    """Validate a request and run it. Raises as `SelectionPlan.of` and `run_plan`."""
    return run_plan(warehouse, SelectionPlan.from_request(warehouse.catalog, request), predicate)


def run_plan(
    warehouse: Warehouse, plan: SelectionPlan, predicate: str, *, nested: bool = False
) -> Selection:
    """Select on the drives of a predicate. Raises as `load_cohort` and `select`.

    Compares the list of logged signals if the default list has no Gram rows. With `nested` a choice
    on labels of measured drives is repeated without the drives to test.
    """
    remark = ""
    try:
        cohort = load_training_set(warehouse, plan, predicate)
    except NotComputedError as error:
        if not plan.is_default:
            raise
        remark = f"Using model list {LOGGED_MODELS} instead of {DEFAULT_MODELS}: {error}"
        plan = plan.with_logged_signals(warehouse.catalog)
        cohort = load_training_set(warehouse, plan, predicate)
    selection = select_models(cohort, plan)
    rmse_deg = selection.winner.model.pooled.rmse_deg
    read = selection.cohort
    quality = assess_course_label(warehouse, read.feature_set, read.predicate, rmse_deg)
    noise_deg = None if quality else label_noise_deg(warehouse, read)
    is_measured = quality is None and noise_deg is None
    return replace(
        selection,
        without_label=quality,
        label_noise_deg=noise_deg,
        remark=remark,
        asked_condition=predicate,
        nested=cross_validate_choice(cohort, plan) if nested and is_measured else None,
    )


# The noise of the label, as campaigns state it.


def label_noise_deg(warehouse: Warehouse, cohort: Cohort) -> float | None:
    """Return the standard deviation of the label's noise, of all rows of a cohort together.

    It is part of every cross-validated error. The quantisation step counts as a uniform error.
    None where no campaign states it in its `[sensors]`.
    """
    if not warehouse.logs.snapshot().rows:  # all Gram rows are from messages
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
    except (ConfigError, KeyError):  # its file is not among the configs
        return None


# Nested cross-validation: the figure of a winner is that of the folds that chose it.

MIN_DRIVES = 3
"""Minimum number of trips to hold out whole trips; with fewer, parts of the time are held out."""

MAX_HELD_OUT = 10
GROUPED = 8
"""Up to `MAX_HELD_OUT` trips are held out one by one; more are dealt into this number of groups."""

MAX_NESTED_DRIVES = 500
"""Maximum number of drives for which a choice is repeated; beyond it, the optimism is small."""


@dataclass(frozen=True)
class NestedErrors(Record):
    """Held-out errors of a choice that is repeated without each group of drives."""

    DOCUMENT = "groups correlation=figures.correlation rmse_deg=figures.rmse_deg"

    groups: int
    figures: Figures


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
        plan = replace(plan, folds=Folding(by="drive", count=plan.folds.count))
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
    compared = len(plan.compared_list(cohort).model)
    has_choice = plan.searches or plan.request.is_ordered or compared > 1
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
    """Read the Gram rows of a plan, of its prior too; the sums of folds alone if they suffice."""
    folding = None if plan.needs_drives else plan.folds
    cohort = load_cohort(warehouse, predicate, plan.feature_set, folding)
    if not plan.request.prior:
        return cohort
    from fleet_slip.models.prior import simulate_prior  # noqa: PLC0415 - only here simulated

    prior = simulate_prior(warehouse.catalog, plan.request.prior, plan.feature_set)
    return replace(cohort, prior=prior)


def select_models(cohort: Cohort, plan: SelectionPlan) -> Selection:
    """Weight the drives of a cohort, then compare what a plan names. Raises as `select`."""
    weighted: dict[str, DownweightedDrive] = {}
    full = 1
    if plan.request.half_life:
        days = cohort.drives["day"].to_pylist()
        cohort, full = cohort.weighted(age_weights(days, plan.request.half_life)), FULL
    if plan.request.robust:
        cohort, weighted = _downweight_outliers(cohort, plan)
        full *= FULL if weighted else 1
    if prior := cohort.prior:
        selection = _select_with_prior(cohort, prior, plan)
    elif plan.request.is_ordered:
        selection = _select_order(cohort, plan)
    else:
        selection = _select_listed(cohort, plan)
    if plan.is_nested:
        inputs = inputs_of(cohort, plan.request.order or WHOLE_SET)
        distances = try_distances(cohort, inputs, plan.folds, plan.request)
        selection = replace(selection, distances=distances)
    return replace(selection, weighted=weighted, full=full, request=plan.original)


def _downweight_outliers(
    cohort: Cohort, plan: SelectionPlan
) -> tuple[Cohort, dict[str, DownweightedDrive]]:
    """Down-weight the drives that are outliers of a model of all compared inputs."""
    request, model_list = plan.request, plan.model_list
    inputs = inputs_of(cohort, request.order or WHOLE_SET)
    if model_list and model_list.model and not (request.order or request.search):
        signals = {name for candidate in model_list.model for name in candidate.signals}
        inputs = tuple(name for name in cohort.inputs if name in signals)
    outliers = outlier_drives(cohort.complete_cases(inputs), intercept=plan.intercept)
    if not outliers:
        return cohort, {}
    parts_of = {name: round(outlier.weight * FULL) for name, outlier in outliers.items()}
    names = cohort.drives["drive_id"].to_pylist()
    return cohort.weighted(np.array([parts_of.get(name, FULL) for name in names])), outliers


def outlier_drives(cases: CompleteCases, *, intercept: bool) -> dict[str, DownweightedDrive]:
    """Return the drives that `robust` down-weights, the most unusual first."""
    table = cases.table if intercept else cases.table.about_origin()
    weights = robust_weights(DriveMoments.from_table(table), intercept=intercept)
    less = np.flatnonzero(weights.weights < FULL).tolist()
    names = cases.drives["drive_id"].to_pylist()
    return {
        names[i]: weights.drive(i) for i in sorted(less, key=lambda i: -float(weights.times[i]))
    }


def _select_listed(cohort: Cohort, plan: SelectionPlan) -> Selection:
    """Compare the candidates and searches of a plan."""
    compared = plan.compared_list(cohort)
    tolerance = None if plan.tolerance is None else parse_tolerance(plan.tolerance)
    selection = select(
        cohort,
        compared.model,
        plan.folds,
        tolerance,
        compared.search,
        cohort.inputs if compared.search else (),
        intercept=plan.intercept,
    )
    order = f"order:{plan.request.order}" if plan.is_nested else None
    name = plan.request.models or (GIVEN if plan.request.model else None)
    title = "+".join(filter(None, [name, order]))
    if not title:
        (search,) = compared.search
        title = f"search:{search.method} {search.max_features}"
    checksum = checksum_of_list(compared, plan.tolerance, plan.intercept)
    return replace(selection, model_list=title, config_sha256=checksum, compared=compared)


MAX_LOST_SHARE = Fraction(1, 10)
"""Maximum share of the drives that a candidate may remove from the comparison of all others."""


def select(
    cohort: Cohort,
    candidates: Sequence[CandidateModel],
    folding: Folding,
    tolerance: Tolerance | None = None,
    searches: Sequence[Search] = (),
    inputs: Sequence[str] = (),
    *,
    intercept: bool = True,
) -> Selection:
    """Cross-validate candidates and searches on the rows that all can use, and choose a winner.

    `tolerance` overrides the rule of the first search. Skips, with the reason, candidates with
    absent or dependent signals, candidates that too few drives have, and searches that need more
    drives. Raises `DataError` if none is left, or no drive has the label.
    """
    folds = _labelled_folds(cohort, folding)
    skipped: dict[str, str] = {}
    candidates = [c for c in candidates if _is_allowed(c, cohort, skipped)]
    searches_run = [s for s in searches if _has_drives(s, cohort, skipped)]
    columns = [name for name in inputs if any(search.among([name]) for search in searches_run)]
    rows = find_complete_cases(folds, cohort.catalog.signals.label, candidates, columns, skipped)
    models = _cross_validate_candidates(rows, cohort.catalog, skipped, intercept=intercept)
    searched: list[SearchedModels] = []
    for search in searches_run:
        bounded = _bounded(search, cohort, folding)
        if models_of := _cross_validate_search(
            rows, columns, bounded, cohort.catalog, skipped, intercept=intercept
        ):
            searched.append(models_of)
            models += models_of.models
    if not models:
        groups = [(names, reason.rstrip(".")) for names, reason in group_skipped(skipped)]
        reasons = [reason if len(groups) == 1 else f"{names}: {reason}" for names, reason in groups]
        raise DataError(f"no candidate model can be fitted: {'; '.join(reasons)}.")
    winner = choose_by(searches[0] if searches else None, models, tolerance)
    if winner.model.name in {candidate.name for candidate in rows.candidates}:
        winner = _refit(winner, folds, rows, cohort.catalog, intercept=intercept)
    return Selection(
        cohort,
        folding,
        tuple(models),
        winner,
        skipped,
        searched=tuple(searched),
        intercept=intercept,
    )


def _labelled_folds(cohort: Cohort, folding: Folding) -> CohortFolds:
    """Divide a cohort into folds. Raises `DataError` if no drive has the label."""
    folds, label = cohort.folds(folding.by, folding.count), cohort.catalog.signals.label
    if not folds.tables_with([label]):
        raise DataError(
            f"no drive of the cohort {cohort.predicate.quoted} has the label, {label}. Where cars "
            "log their course, learn from it: fleet-slip select --label course"
        )
    return folds


def _is_allowed(candidate: CandidateModel, cohort: Cohort, skipped: dict[str, str]) -> bool:
    """Return True if a candidate may be trained on the feature set; else note why not."""
    try:
        require_odd(cohort.catalog, candidate.signals, cohort.feature_set)
    except QuestionError as error:
        skipped[candidate.name] = str(error)
        return False
    return True


def _has_drives(search: Search, cohort: Cohort, skipped: dict[str, str]) -> bool:
    """Return True if a cohort has the drives that a search needs; else note why not."""
    drives = cohort.drive_count
    if drives >= search.min_drives:
        return True
    reason = f"it needs {search.min_drives} drives, and there are {drives}"
    skipped[f"{search.title} (search)"] = reason
    return False


@dataclass(frozen=True)
class ComparedRows:
    """The rows on which all candidates are compared.

    Attributes
    ----------
    folds
        Rows that have the signals of all candidates and all columns.
    candidates
        The comparable candidates, in their order.
    columns
        The comparable columns of searches, in their order.
    """

    folds: CohortFolds
    candidates: tuple[CandidateModel, ...]
    columns: tuple[str, ...]


def find_complete_cases(
    folds: CohortFolds,
    label: str,
    candidates: Sequence[CandidateModel],
    columns: Sequence[str],
    skipped: dict[str, str],
) -> ComparedRows:
    """Find the rows that all comparable candidates and columns can use; note the others.

    Candidates, and then columns, join one by one, the most common first, unless fewer drives would
    have all signals than 1 - `MAX_LOST_SHARE` of the drives of the most common.
    """

    @cache
    def count_drives(tables: tuple[int, ...]) -> int:
        return folds.count_drives(tables) if tables else 0

    def drives_with(signals: Collection[str]) -> int:
        return count_drives(folds.tables_with([*signals, label]))

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
            rare = [
                signal for signal in sorted(signals) if drives_with([signal]) < total
            ] or sorted(signals)
            lost = f"{total - remaining:,} of {pluralize(total, 'drive')}"
            skipped[name] = _missing_signals(folds, label, signals) or (
                f"not comparable: {lost} lack {', '.join(rare)}, and only a tenth may be left out"
            )
    chosen = sorted(comparable)
    return ComparedRows(
        folds.with_signals([*common, label]),
        tuple(candidates[i] for i in chosen if i < len(candidates)),
        tuple(entries[i][0] for i in chosen if i >= len(candidates)),
    )


def _missing_signals(folds: CohortFolds, label: str, signals: Collection[str]) -> str | None:
    """Return why no fold has rows with the signals; None if folds have."""
    try:
        folds.complete_cases(sorted(signals), label, sparse=True)
    except DataError as error:
        return str(error)
    return None


def _cross_validate_candidates(
    rows: ComparedRows, catalog: Catalog, skipped: dict[str, str], *, intercept: bool
) -> list[CrossValidation]:
    """Cross-validate the candidates; note those with dependent signals."""
    models = []
    for candidate in rows.candidates:
        try:
            models.append(
                _cross_validate(candidate.name, candidate.signals, rows.folds, catalog, intercept)
            )
        except DataError as error:
            skipped[candidate.name] = str(error)
    return models


def _cross_validate(
    name: str, signals: Sequence[str], folds: CohortFolds, catalog: Catalog, intercept: bool
) -> CrossValidation:
    """Cross-validate least squares on the rows that have the signals. Raises `DataError`."""
    label = catalog.signals.label
    complete = folds.complete_cases(signals, label, sparse=True)
    procedure = least_squares(signals, label, intercept=intercept)
    return cross_validate(name, complete, procedure, catalog.input_scales)


def _bounded(search: Search, cohort: Cohort, folding: Folding) -> Search:
    """Return a search with at most the columns that it may take for so many drives."""
    if not search.max_features_per_drive or folding.by == PARTS:
        return search
    limit = search.max_features_per_drive * cohort.drive_count
    return search.model_copy(update={"max_features": min(search.max_features, limit)})


def _cross_validate_search(
    rows: ComparedRows,
    columns: Sequence[str],
    search: Search,
    catalog: Catalog,
    skipped: dict[str, str],
    *,
    intercept: bool,
) -> SearchedModels | None:
    """Search among the comparable columns; note the others, and why a search has no model."""
    among = search.among(rows.columns)
    if rare := [name for name in search.among(columns) if name not in among]:
        names, more = ", ".join(rare[:MAX_LISTED_INPUTS]), len(rare) - MAX_LISTED_INPUTS
        skipped[f"{search.title} (columns)"] = (
            f"not comparable: more than a tenth of the drives lack {names}"
            + (f" and {more} more" if more > 0 else "")
        )
    if not among:
        return None
    label, scales = catalog.signals.label, catalog.input_scales
    try:
        return search_models(rows.folds, among, label, scales, search, intercept=intercept)
    except DataError as error:  # no drive, or not one in each fold, has all inputs
        skipped[f"{search.title} (search)"] = str(error)
        return None


def _refit(
    winner: Winner, folds: CohortFolds, rows: ComparedRows, catalog: Catalog, *, intercept: bool
) -> Winner:
    """Fit a winner to all rows that have its signals, where these are more than the compared."""
    signals = winner.model.signals
    if len(folds.tables_with([*signals, catalog.signals.label])) == len(rows.folds.tables):
        return winner
    model = _cross_validate(winner.model.name, signals, folds, catalog, intercept)
    return replace(winner, model=model)


PRIOR_SHARE = Fraction(1, 8)
"""Weight of all rows of a prior together, where those of the cohort have 1 (docs/measured.md)."""


MAX_PRIOR_COST = 1 / 10
"""Largest increase of the RMSE on held-out drives with a prior, as a share: on five recordings of
real cars a good prior costs at most a twentieth (docs/measured.md)."""


def keeps_prior(with_prior: float, without: float, drives: int) -> bool:
    """Return True if the RMSE of a model with a prior allows keeping the prior.

    It may exceed the RMSE without by `MAX_PRIOR_COST`, or 1/n for more drives n: held-out drives
    are like the training drives, and flatter a selection.
    """
    return with_prior <= without * (1 + min(MAX_PRIOR_COST, 1 / drives))


def _select_with_prior(cohort: Cohort, prior: Cohort, plan: SelectionPlan) -> Selection:
    """Fit all inputs with the prior (no search: the prior regularises), or select without it."""
    selection = _select_listed(replace(cohort, prior=None), plan)
    alone = selection.winner.model
    searched = next((search.inputs for search in plan.searches if search.inputs), ())
    signals = tuple(name for name in searched if name in cohort.inputs) or alone.signals
    share = PRIOR_SHARE * Fraction(cohort.rows, prior.rows)
    weighted = replace(cohort, weight=Fraction(2) ** round(math.log2(share)))
    folds = weighted.folds(plan.folds.by, plan.folds.count)
    joined = _cross_validate("prior", signals, folds, cohort.catalog, plan.intercept)
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
    """Rank the inputs of an order, or search all their subsets, and choose a size."""
    request = plan.request
    order = request.order or WHOLE_SET
    inputs = inputs_of(cohort, order)
    ranking = ALL_SUBSETS if request.all_subsets else request.ranking or "declared"
    criterion = require_criterion(request.criterion or "cv")
    rule = Rule(ranking, criterion, parse_tolerance(plan.tolerance))
    result = select_inputs(cohort, inputs, plan.folds, rule, request)
    described = ModelList(
        description="Inputs to choose from",
        features=cohort.feature_set,
        folds=plan.folds,
        model=(CandidateModel(name="inputs", signals=inputs),),
    )
    content = {"inputs": described.sha256, "ranking": rule.ranking, "criterion": rule.criterion}
    content |= {"evidence": result.choice.evidence.kind}
    compared = sha256_of(canonical_json(content))
    return Selection(
        cohort,
        plan.folds,
        result.models,
        result.winner,
        {},
        choice=result.choice,
        intercept=plan.intercept,
        model_list=f"order:{order} {rule.ranking} {rule.criterion}",
        config_sha256=checksum_with_options(compared, plan.tolerance, plan.intercept),
    )
