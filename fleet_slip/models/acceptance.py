"""Review of a challenger: the thresholds of `publish.toml`, and a comparison with the champion.

The challenger is judged on held-out rows: neither its coefficients nor its columns saw them. A
search is repeated without them for the same number of columns. The champion is compared with its
published coefficients on the same rows, so the standard error is that of a paired difference,
clustered by car, or by drive where there are few cars. The best champion so far is compared too:
many small losses must not add up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from fleet_slip.arrays import BoolArray
from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.config import Config, load_config, refuse_renamed
from fleet_slip.errors import DataError, QuestionError, RefusedError, StorageError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.folding import FOLD_KEYS, FoldKey, assign_folds
from fleet_slip.grams.gram_files import hash_names
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import CHAMPION, ModelVersion, Registry
from fleet_slip.models.search import search_procedure
from fleet_slip.models.select import Selection
from fleet_slip.regression.choice import RmseGap, Tolerance, compare_paired
from fleet_slip.regression.folds import (
    CohortFolds,
    CrossValidation,
    FoldAssignment,
    Folds,
    Procedure,
    assemble,
    error_sums,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.least_squares import LinearModel
from fleet_slip.resources import Configs
from fleet_slip.storage.runs import LOGGER
from fleet_slip.warehouse.predicate import parse_predicate


class PublishThresholds(Config):
    """Thresholds for every champion; `configs/publish.toml` explains each."""

    min_correlation: float = Field(gt=-1, lt=1)
    max_rmse_deg: float = Field(gt=0)
    min_drives: int = Field(ge=1)
    min_vehicles: int = Field(ge=1)
    min_part_of_champion: float = Field(ge=0, le=1)
    tolerance_deg: float = Field(ge=0)
    max_columns_per_drive: float = Field(default=3.0, gt=0)
    min_rows_per_column: int = Field(default=100, ge=1)

    @model_validator(mode="before")
    @classmethod
    def _refuse_renamed(cls, content: Any) -> Any:
        return refuse_renamed(content, {"worth_deg": "tolerance_deg"})

    @property
    def tolerance(self) -> Tolerance:
        """RMSE gap to the champion that is no reason to refuse a challenger."""
        return Tolerance(math.radians(self.tolerance_deg))


def load_thresholds(configs: Configs) -> PublishThresholds:
    """Read `publish.toml`. Raises `ConfigError`."""
    return load_config(configs.file("publish.toml"), PublishThresholds)


MIN_VEHICLES = 5
"""Minimum number of cars to hold out cars; with fewer, drives are held out."""

MAX_STANDARD_ERRORS = 3.0
"""A champion stays if the challenger is worse by more than this many standard errors."""

MAX_GROUPS = 20
"""Maximum number of groups that are held out in turn. Each costs one exact fit."""


@dataclass(frozen=True)
class Comparison:
    """A challenger and published versions on the same held-out rows.

    Attributes
    ----------
    by
        What was held out, vehicle or drive.
    challenger
        Refitted without each group that it is tested on.
    incumbents
        The champion, and the best champion so far if it is another version.
    gaps
        RMSE gap of the challenger to each incumbent.
    unseen
        True if no incumbent was trained on these rows.
    of_lines
        True if a version has a filter, which is not compared.
    """

    by: FoldKey
    challenger: CrossValidation
    incumbents: tuple[CrossValidation, ...]
    gaps: tuple[RmseGap, ...]
    unseen: bool = False
    of_lines: bool = False

    @property
    def better(self) -> tuple[CrossValidation, ...]:
        """The incumbents that the challenger is worse than."""
        return tuple(
            incumbent
            for incumbent, shortfall in zip(self.incumbents, self.gaps, strict=True)
            if not shortfall.negligible
        )

    @property
    def is_significantly_worse(self) -> bool:
        """True if the challenger is worse than the champion by many standard errors."""
        gap = self.gaps[0]
        has_groups = len(self.challenger.folds) >= MIN_VEHICLES
        return has_groups and gap.rmse > MAX_STANDARD_ERRORS * gap.standard_error

    @property
    def contradicted(self) -> bool:
        """True if an incumbent correlates negatively with the label."""
        return any(incumbent.pooled.correlation < 0 for incumbent in self.incumbents)

    @property
    def best(self) -> str | None:
        """The best incumbent if it is better than the challenger, else None."""
        best = min(self.incumbents, key=lambda incumbent: incumbent.pooled.rmse)
        return best.name if best.pooled.rmse < self.challenger.pooled.rmse else None

    def __str__(self) -> str:
        challenger = self.challenger.pooled
        incumbents = "; ".join(
            f"{incumbent.name} as published has {incumbent.pooled.rmse_deg:.4f} deg and "
            f"{incumbent.pooled.correlation:.4f}, difference {gap}"
            for incumbent, gap in zip(self.incumbents, self.gaps, strict=True)
        )
        alone = "the linear model alone, since Gram rows contain no filter: " * self.of_lines
        return (
            f"{alone}on the same {pluralize(challenger.rows, 'row')} of "
            f"{pluralize(self.challenger.drives, 'drive')}"
            f"{' that are new to both' if self.unseen else ''}, held out "
            f"in {len(self.challenger.folds)} groups by {self.by}, it has RMSE "
            f"{challenger.rmse_deg:.4f} deg and correlation {challenger.correlation:.4f}; "
            f"{incumbents}"
        )


@dataclass(frozen=True)
class ChallengerEvaluation:
    """How to refit a challenger without held-out groups, and the incumbents to compare it with.

    Attributes
    ----------
    name
        The challenger's.
    signals
        Inputs of the challenger and all incumbents.
    by
        What is held out, vehicle or drive.
    procedure
        Fits the challenger; searches its columns again if a search found them.
    incumbents
        Published models in counts, by reference.
    tolerance
        RMSE gap that is no reason to refuse the challenger.
    """

    catalog: Catalog
    name: str
    signals: tuple[str, ...]
    by: FoldKey
    procedure: Procedure
    incumbents: dict[str, LinearModel]
    tolerance: Tolerance

    def complete_folds(self, folds: CohortFolds) -> Folds:
        """Return the folds of drives with all signals. Raises `DataError` without."""
        return folds.complete_cases(self.signals, self.catalog.signals.label, sparse=True)

    def folds_of(self, cohort: Cohort, mask: BoolArray) -> Folds:
        """Return the masked drives in the groups of the whole cohort. Raises `DataError`."""
        values = cohort.drives[FOLD_KEYS[self.by]].to_pylist()
        groups = assign_folds(values, self.by, MAX_GROUPS)
        used, fold = np.unique(groups.fold[mask], return_inverse=True)
        names = tuple(groups.names[number] for number in used.tolist())
        drives = cohort.filter(mask)
        assignment = FoldAssignment(fold, names)
        return self.complete_folds(
            CohortFolds.from_tables(drives.tables, assignment, drives.drive_numbers)
        )

    def compare(self, training: Folds, tested: Folds) -> Comparison:
        """Fit the challenger without each group of `training` and compare on `tested`."""
        tests = dict(zip(tested.names, tested.grams, strict=True))
        sums = [
            held_out_errors(self.procedure(remaining), remaining, tests[name])
            for name, (remaining, _) in zip(training.names, training.splits(), strict=True)
            if name in tests
        ]
        fitted = self.procedure(training.total)
        challenger = assemble(self.name, tested, sums, fitted, self.catalog.input_scales)
        incumbents = tuple(
            evaluate_frozen(self.catalog, name, model, tested)
            for name, model in self.incumbents.items()
        )
        gaps = tuple(
            compare_paired(challenger, incumbent, self.tolerance) for incumbent in incumbents
        )
        return Comparison(self.by, challenger, incumbents, gaps)


def prepare_evaluation(
    selection: Selection, incumbents: Sequence[ModelVersion]
) -> ChallengerEvaluation:
    """Prepare the comparison of a selection's winner with published versions.

    Raises `DataError` or `QuestionError` if columns of a version are defined differently now.
    """
    catalog, feature_set = selection.cohort.catalog, selection.cohort.feature_set
    for version in incumbents:
        _require_same_features(catalog, version, feature_set)
    winner, search = selection.winner.model, selection.searched_winner
    label = catalog.signals.label
    inputs = search.inputs if search is not None else winner.signals
    models = {
        version.reference: version.manifest.counts_model(catalog, feature_set)
        for version in incumbents
    }
    incumbent_signals = (name for model in models.values() for name in model.signals)
    signals = tuple(dict.fromkeys((*inputs, *incumbent_signals)))
    cars = selection.cohort.count_vehicles_with((*signals, label))
    by: FoldKey = "vehicle" if cars >= MIN_VEHICLES else "drive"
    intercept = selection.intercept
    if search is not None:
        procedure = search_procedure(label, search, len(winner.signals), intercept=intercept)
    else:
        procedure = least_squares(inputs, label, intercept=intercept)
    tolerance = load_thresholds(catalog.configs).tolerance
    return ChallengerEvaluation(catalog, winner.name, signals, by, procedure, models, tolerance)


def compare(selection: Selection, incumbents: Sequence[ModelVersion]) -> Comparison:
    """Compare a selection's winner with the published coefficients of versions.

    Raises `DataError` or `QuestionError` if no drive has all signals, and as `prepare_evaluation`.
    """
    evaluation = prepare_evaluation(selection, incumbents)
    groups = evaluation.complete_folds(selection.cohort.folds(evaluation.by, MAX_GROUPS))
    return evaluation.compare(groups, groups)


def compare_unseen(
    registry: Registry, selection: Selection, incumbents: Sequence[ModelVersion]
) -> Comparison | None:
    """Compare only on drives that no incumbent was trained on: elsewhere it has an advantage.

    Returns None if no drive, every drive, or drives of fewer than `MIN_VEHICLES` groups are such.
    Raises as `compare`, and `StorageError` if a training set cannot be read.
    """
    if (split := _split_by_training(registry, selection, incumbents)) is None:
        return None
    cohort, is_trained = split
    evaluation = prepare_evaluation(selection, incumbents)
    groups = evaluation.folds_of(cohort, np.ones_like(is_trained))
    unseen = evaluation.folds_of(cohort, ~is_trained)
    if len(unseen.names) < MIN_VEHICLES:
        return None
    return replace(evaluation.compare(groups, unseen), unseen=True)


MAX_REVIEWED_DRIVES = 20_000
"""Of a larger cohort about this many drives, chosen by their hash, are compared."""

_HEX = 4


def _split_by_training(
    registry: Registry, selection: Selection, versions: Sequence[ModelVersion]
) -> tuple[Cohort, BoolArray] | None:
    """Return a selection's cohort and the mask of drives that any of the versions was trained on.

    Returns None if the mask has one value. Raises `StorageError` if a training set cannot be read.
    """
    training_sets = [registry.trained_drives(version.manifest) for version in versions]
    cohort = selection.cohort
    if cohort.source is not None and cohort.sums is not None:
        predicate, drives = cohort.predicate, cohort.drive_count
        if drives > MAX_REVIEWED_DRIVES:
            below = 16**_HEX * MAX_REVIEWED_DRIVES // drives
            sample = f"left(sha256('vouched ' || drive_id), {_HEX}) < '{below:0{_HEX}x}'"
            predicate &= parse_predicate(cohort.catalog.signals, sample)
        cohort = load_cohort(cohort.source, predicate, cohort.feature_set)
    hashes = hash_names(cohort.drives["drive_id"])
    is_trained = np.any([drives.among(hashes) for drives in training_sets], axis=0)
    return (cohort, is_trained) if is_trained.any() and not is_trained.all() else None


def evaluate_frozen(
    catalog: Catalog, name: str, model: LinearModel, folds: Folds
) -> CrossValidation:
    """Return the figures of a model over folds without refitting it."""
    tests = [error_sums(model, test) for test in folds.grams]
    return assemble(name, folds, tests, model, catalog.input_scales)


def threshold_violations(
    thresholds: PublishThresholds, manifest: Manifest, champion: Manifest | None
) -> list[str]:
    """Return the thresholds that a manifest does not reach, as phrases."""
    figures, trained = manifest.cross_validation, manifest.trained_on
    violations = []
    start = "without the filter, its" if manifest.line_remark else "its"
    if figures.correlation < thresholds.min_correlation:
        violations.append(
            f"{start} correlation is {figures.correlation:.4f}, below {thresholds.min_correlation}"
        )
    if figures.rmse_deg > thresholds.max_rmse_deg:
        violations.append(
            f"{start} RMSE is {figures.rmse_deg:.4f} deg, above {thresholds.max_rmse_deg} deg"
        )
    counts = (
        (trained.drives, "drive", thresholds.min_drives),
        (trained.vehicles, "car", thresholds.min_vehicles),
    )
    violations += [
        f"it was trained on {pluralize(count, noun)}, fewer than {minimum}"
        for count, noun, minimum in counts
        if count < minimum
    ]
    if champion is not None:
        violations += _too_small_share(manifest, champion, thresholds.min_part_of_champion)
    return violations


def missing_evidence(thresholds: PublishThresholds, manifest: Manifest) -> list[str]:
    """Return why a first champion of measured drives has too many columns for its data."""
    if manifest.learned_from is not None:
        return []
    reasons = []
    columns, trained = len(manifest.terms), manifest.trained_on
    has_prior = manifest.prior is not None and manifest.prior.weight
    if not has_prior and columns > thresholds.max_columns_per_drive * trained.drives:
        drives = pluralize(trained.drives, "drive")
        maximum = f"{thresholds.max_columns_per_drive:g}"
        reasons.append(f"it has {columns} columns on {drives}, more than {maximum} a drive")
    if trained.rows < thresholds.min_rows_per_column * columns:
        rows = pluralize(trained.rows, "row")
        minimum = f"{thresholds.min_rows_per_column} for each of its {columns} columns"
        reasons.append(f"it was trained on {rows}, fewer than {minimum}")
    return reasons


def _too_small_share(manifest: Manifest, champion: Manifest, share: float) -> list[str]:
    """Return in what the training set is smaller than this share of the champion's."""
    pairs = (
        ("drives", manifest.trained_on.drives, champion.trained_on.drives),
        ("cars", manifest.trained_on.vehicles, champion.trained_on.vehicles),
    )
    return [
        f"it was trained on {count:,} {noun}, less than {share:.0%} of the champion's {reference:,}"
        for noun, count, reference in pairs
        if count < share * reference
    ]


def _has_another_line(catalog: Catalog, version: ModelVersion, feature_set: str) -> bool:
    """Return True if a version has the same set with another first-stage model.

    Its columns are then in no Gram row of this feature set.
    """
    model, identity = (
        catalog.first_stage_model(feature_set),
        version.manifest.trained_on.feature_set,
    )
    if model is None or identity == catalog.identity(feature_set):
        return False
    return identity.startswith(feature_set.removesuffix(model.digest))


def _require_same_features(catalog: Catalog, version: ModelVersion, feature_set: str) -> None:
    """Raise `DataError` if a feature or column of a version is defined differently now."""
    manifest, definitions = version.manifest, catalog.definitions(feature_set)
    for name, feature in manifest.features.items():
        if catalog.rows([name]).get(name) != feature:
            raise DataError(f"the feature {name} has changed since {version.reference}.")
    for name, definition in manifest.definitions.items():
        current = None
        if name in catalog.inputs:
            current = definitions.get(name) or catalog.definition(name)
        if current != definition:
            raise DataError(f"the column {name} has changed since {version.reference}.")


# A challenger that was trained on unusual drives is better on them, held out or not. If the
# champion's error on new drives is much larger than on its training set, both are compared on that
# training set alone.

OUTLIER_RATIO = 2.0
"""Drives are unusual if the champion's RMSE on them exceeds this multiple of its usual RMSE."""


def gain_on_outliers_only(
    registry: Registry, selection: Selection, champion: ModelVersion
) -> str | None:
    """Return a reason to refuse if the challenger is better on unusual new drives alone.

    Returns None where all drives are new, or none. Raises `DataError` if there are too few of
    either, and `StorageError` if the champion's training set cannot be read.
    """
    if (split := _split_by_training(registry, selection, [champion])) is None:
        return None
    cohort, is_trained = split
    evaluation = prepare_evaluation(selection, [champion])
    groups, old, new = (
        evaluation.folds_of(cohort, mask)
        for mask in (np.ones_like(is_trained), is_trained, ~is_trained)
    )
    ((name, model),) = evaluation.incumbents.items()
    on_old, on_new = (
        evaluate_frozen(evaluation.catalog, name, model, folds).pooled for folds in (old, new)
    )
    if on_new.rmse_deg <= OUTLIER_RATIO * on_old.rmse_deg:
        return None
    comparison = evaluation.compare(groups, old)
    (gap,) = comparison.gaps
    if gap.negligible:
        return None
    return (
        "the improvement comes only from unusual new drives: on the training set of "
        f"{champion.reference} it has {comparison.challenger.pooled.rmse_deg:.4f} deg and the "
        f"champion {on_old.rmse_deg:.4f} deg, difference {gap}; on the new drives the champion has "
        f"{on_new.rmse_deg:.4f} deg. Check these before training"
    )


@dataclass(frozen=True)
class Review:
    """Result of a review.

    Attributes
    ----------
    problems
        Reasons to refuse the challenger.
    compared
        The comparison as a phrase.
    best
        Number of an earlier champion that is better, None if none is.
    is_significantly_worse
        True if the champion is better, though not by a refusable gap.
    """

    problems: tuple[str, ...]
    compared: str
    best: int | None = None
    is_significantly_worse: bool = False

    @property
    def reason(self) -> str:
        """The problems, else the comparison, as a sentence."""
        text = "; ".join(self.problems) or self.compared
        return f"{text[:1].upper()}{text[1:]}."

    def require_passed(self, name: str) -> None:
        """Raise `RefusedError` if there are problems."""
        if self.problems:
            raise RefusedError(
                f"{name} was not published: {'; '.join(self.problems)}. Check the data. To "
                "publish it anyway: --force"
            )


def review_challenger(
    registry: Registry,
    champion: ModelVersion | None,
    manifest: Manifest,
    selection: Selection,
) -> Review:
    """Compare a challenger with the thresholds, the champion, and the best champion so far."""
    catalog = selection.cohort.catalog
    thresholds = load_thresholds(catalog.configs)
    problems = threshold_violations(thresholds, manifest, champion.manifest if champion else None)
    if champion is None:
        return Review(tuple(problems), "It is the first version")
    if _has_another_line(catalog, champion, selection.cohort.feature_set):
        return _review_another_line(champion, selection, thresholds, problems)
    try:
        incumbents = _incumbents(registry, champion)
        comparison = compare(selection, incumbents)
        if comparison.better:
            comparison = compare_unseen(registry, selection, incumbents) or comparison
        manifests = [manifest, *(version.manifest for version in incumbents)]
        comparison = replace(comparison, of_lines=any(m.line_remark for m in manifests))
    except (DataError, QuestionError) as error:
        feature_set, _, _ = champion.manifest.trained_on.feature_set.partition("-")
        problems.append(
            f"the champion {champion.reference} cannot be compared: {str(error).rstrip('.')} (its "
            f"feature set is {feature_set}; choose a model list that has this set: --models LIST)"
        )
        return Review(tuple(problems), "")
    problems += _comparison_problems(comparison, champion)
    if not problems and champion.manifest.learned_from is None and manifest.learned_from is None:
        problems += _unusual_drives(comparison, champion)
    if not problems:
        problems += _outlier_problems(registry, selection, champion)
    best = next((v.version for v in incumbents if v.reference == comparison.best), None)
    return Review(tuple(problems), str(comparison), best, comparison.is_significantly_worse)


def _review_another_line(
    champion: ModelVersion,
    selection: Selection,
    thresholds: PublishThresholds,
    problems: list[str],
) -> Review:
    """Compare cross-validated RMSEs: the first-stage model was refitted, so no row has both."""
    old, new = (
        champion.manifest.cross_validation.rmse_deg,
        selection.winner.model.pooled.rmse_deg,
    )
    compared = (
        f"its first-stage model was fitted again; its cross-validated RMSE is {new:.4f} deg, that "
        f"of {champion.reference} was {old:.4f} deg"
    )
    worse = [compared] if new > old + thresholds.tolerance_deg else []
    return Review((*problems, *worse), compared)


def _incumbents(registry: Registry, champion: ModelVersion) -> list[ModelVersion]:
    """Return the champion, and the best champion so far if it is another version."""
    name = champion.manifest.name
    best = registry.history(name).best_of(CHAMPION)
    return [champion, *([] if best in (None, champion.version) else [registry.load(name, best)])]


def _comparison_problems(comparison: Comparison, champion: ModelVersion) -> list[str]:
    """Return the reasons to refuse that a comparison on held-out rows gives."""
    problems = []
    if comparison.contradicted:
        problems.append(
            f"the label has the opposite sign of the estimates of {champion.reference}. Is it "
            f"reversed? {comparison}"
        )
    better = [incumbent.name for incumbent in comparison.better]
    if champion.reference in better:
        problems.append(f"it is worse than the champion: {comparison}")
    elif better:
        problems.append(
            f"it is worse than {better[0]}, the best champion so far, after several small losses: "
            f"{comparison}. To accept the present champion as the new reference: fleet-slip "
            f"promote {champion.reference}"
        )
    return problems


def _unusual_drives(comparison: Comparison, champion: ModelVersion) -> list[str]:
    """Return a reason to refuse if the champion's error is much larger than when it was trained."""
    old = champion.manifest.cross_validation.rmse_deg
    new = comparison.incumbents[0].pooled.rmse_deg
    if new <= OUTLIER_RATIO * old:
        return []
    return [
        f"{champion.reference} had a cross-validated RMSE of {old:.4f} deg and has {new:.4f} deg "
        "here: these drives differ from its training set. Check them before training: "
        f"{comparison}"
    ]


def _outlier_problems(
    registry: Registry, selection: Selection, champion: ModelVersion
) -> list[str]:
    """Return the reason of `gain_on_outliers_only`, or why the training set cannot be compared."""
    try:
        reason = gain_on_outliers_only(registry, selection, champion)
    except StorageError as error:
        return [f"no comparison on the champion's training set: {error}"]
    except DataError as error:
        LOGGER.warning(
            "not checked whether the improvement comes only from unusual drives: %s", error
        )
        return []
    return [reason] if reason else []
