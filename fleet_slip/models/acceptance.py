"""Review of a challenger: the thresholds of `publish.toml`, and a comparison with the champion.

The challenger is judged on held-out rows: neither its coefficients nor its columns saw them. A
search is repeated without them for the same number of columns. The champion is compared with its
published coefficients on the same rows, so the standard error is that of a paired difference,
clustered by car, or by drive where there are few cars.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from fleet_slip.arrays import BoolArray
from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.config import Config, load_config
from fleet_slip.errors import DataError, QuestionError, StorageError
from fleet_slip.grams.cohort import (
    FOLD_KEYS,
    Cohort,
    FoldKey,
    assign_folds,
    hash_names,
    load_cohort,
)
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.select import search_procedure
from fleet_slip.models.summary import Selection
from fleet_slip.regression.choice import RmseGap, compare_paired
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
    """A challenger and the champion on the same held-out rows.

    Attributes
    ----------
    by
        What was held out, vehicle or drive.
    challenger
        Refitted without each group that it is tested on.
    champion
        With its published coefficients.
    gap
        RMSE gap of the challenger to the champion.
    unseen
        True if the champion was not trained on these rows.
    """

    by: FoldKey
    challenger: CrossValidation
    champion: CrossValidation
    gap: RmseGap
    unseen: bool = False

    @property
    def is_significantly_worse(self) -> bool:
        """True if the challenger is worse than the champion by many standard errors."""
        has_groups = len(self.challenger.folds) >= MIN_VEHICLES
        return has_groups and self.gap.rmse > MAX_STANDARD_ERRORS * self.gap.standard_error

    def __str__(self) -> str:
        challenger, champion = self.challenger.pooled, self.champion.pooled
        gap_deg, error_deg = math.degrees(self.gap.rmse), math.degrees(self.gap.standard_error)
        return (
            f"on the same {pluralize(challenger.rows, 'row')} of "
            f"{pluralize(self.challenger.drives, 'drive')}"
            f"{' that are new to both' if self.unseen else ''}, held out in "
            f"{len(self.challenger.folds)} groups by {self.by}, it has RMSE "
            f"{challenger.rmse_deg:.4f} deg and correlation {challenger.correlation:.4f}; "
            f"{self.champion.name} as published has {champion.rmse_deg:.4f} deg and "
            f"{champion.correlation:.4f}, difference {gap_deg:.4f} +- {error_deg:.2g} deg"
        )


@dataclass(frozen=True)
class ChallengerEvaluation:
    """How to refit a challenger without held-out groups, and the champion to compare it with.

    Attributes
    ----------
    selection
        Its winner is the challenger.
    reference, model
        The champion, in counts.
    signals
        Inputs of the challenger and the champion.
    by
        What is held out, vehicle or drive.
    procedure
        Fits the challenger; searches its columns again if a search found them.
    """

    selection: Selection
    reference: str
    model: LinearModel
    signals: tuple[str, ...]
    by: FoldKey
    procedure: Procedure

    @classmethod
    def prepare(cls, selection: Selection, champion: ModelVersion) -> "ChallengerEvaluation":
        """Prepare the comparison of a selection's winner with the champion.

        Raises `DataError` or `QuestionError` if columns of it are defined differently now.
        """
        catalog, feature_set = selection.cohort.catalog, selection.cohort.feature_set
        _require_same_columns(catalog, champion, feature_set)
        model = champion.manifest.counts_model(catalog, feature_set)
        winner, search = selection.winner.model, selection.searched_winner
        label = catalog.signals.label
        if search is None:
            inputs, procedure = winner.signals, least_squares(winner.signals, label)
        else:
            inputs = search.inputs
            procedure = search_procedure(label, search, len(winner.signals))
        signals = tuple(dict.fromkeys((*inputs, *model.signals)))
        cars = selection.cohort.count_vehicles_with((*signals, label))
        by: FoldKey = "vehicle" if cars >= MIN_VEHICLES else "drive"
        return cls(selection, champion.reference, model, signals, by, procedure)

    def groups(self, cohort: Cohort, mask: BoolArray | None = None) -> Folds:
        """Return the drives that have all signals, by group, or the masked drives of each group.

        Raises `DataError` without.
        """
        if mask is None:
            folds = cohort.folds(self.by, MAX_GROUPS)
        else:
            values = cohort.drives[FOLD_KEYS[self.by]].to_pylist()
            groups = assign_folds(values, self.by, MAX_GROUPS)
            used, fold = np.unique(groups.fold[mask], return_inverse=True)
            names = tuple(groups.names[number] for number in used.tolist())
            drives = cohort.filter(mask)
            folds = CohortFolds.from_tables(
                drives.tables, FoldAssignment(fold, names), drives.drive_numbers
            )
        folds = replace(folds, has_intercept=self.selection.compared.intercept)
        return folds.complete_cases(self.signals, cohort.catalog.signals.label)

    def as_published(self, tested: Folds) -> CrossValidation:
        """Return the figures of the champion without refitting it."""
        sums = [error_sums(self.model, test) for test in tested.grams]
        scales = self.selection.cohort.catalog.input_scales
        return assemble(self.reference, tested, sums, self.model, scales)

    def compare(self, training: Folds, tested: Folds) -> Comparison:
        """Fit the challenger without each group of `training` and compare on `tested`."""
        catalog = self.selection.cohort.catalog
        tests = dict(zip(tested.names, tested.grams, strict=True))
        sums = [
            held_out_errors(self.procedure(remaining), remaining, tests[name])
            for name, (remaining, _) in zip(training.names, training.splits(), strict=True)
            if name in tests
        ]
        fitted, name = self.procedure(training.total), self.selection.winner.model.name
        challenger = assemble(name, tested, sums, fitted, catalog.input_scales)
        champion = self.as_published(tested)
        tolerance = math.radians(load_thresholds(catalog.configs).tolerance_deg)
        gap = compare_paired(challenger, champion, tolerance)
        return Comparison(self.by, challenger, champion, gap)


MAX_REVIEWED_DRIVES = 20_000
"""Of a larger cohort about this many drives, chosen by their hash, are compared."""

_HEX = 4


def _split_drives(
    registry: Registry, selection: Selection, champion: ModelVersion
) -> tuple[Cohort, BoolArray]:
    """Return the drives of a selection, and the mask of those that a version was trained on.

    Raises `StorageError` if its training set cannot be read.
    """
    trained_drives = registry.trained_drives(champion.manifest)
    cohort = selection.cohort
    if cohort.source is not None and cohort.sums is not None:
        predicate, drives = cohort.predicate, cohort.drive_count
        if drives > MAX_REVIEWED_DRIVES:
            below = 16**_HEX * MAX_REVIEWED_DRIVES // drives
            sample = f"left(sha256('vouched ' || drive_id), {_HEX}) < '{below:0{_HEX}x}'"
            predicate &= parse_predicate(cohort.catalog.signals, sample)
        cohort = load_cohort(cohort.source, predicate, cohort.feature_set)
    return cohort, trained_drives.among(hash_names(cohort.drives["drive_id"]))


def _compare_unseen(
    evaluation: ChallengerEvaluation, cohort: Cohort, is_trained: BoolArray
) -> Comparison | None:
    """Compare on drives that the champion was not trained on: elsewhere it has an advantage.

    Returns None if they are of fewer than `MIN_VEHICLES` groups. Raises `DataError`.
    """
    unseen = evaluation.groups(cohort, ~is_trained)
    if len(unseen.names) < MIN_VEHICLES:
        return None
    groups = evaluation.groups(cohort, np.ones_like(is_trained))
    return replace(evaluation.compare(groups, unseen), unseen=True)


OUTLIER_RATIO = 2.0
"""Drives are unusual if the champion's RMSE on them exceeds this multiple of its usual RMSE."""


def _unusual_drives(
    evaluation: ChallengerEvaluation, cohort: Cohort, is_trained: BoolArray
) -> list[str]:
    """Return a reason to refuse if the challenger is better on unusual new drives alone.

    Such drives make it better on them, held out or not. If the champion's error on new drives is
    much larger than on its training set, both are compared on that training set.
    """
    old, new = (evaluation.groups(cohort, mask) for mask in (is_trained, ~is_trained))
    on_old, on_new = (evaluation.as_published(tested).pooled.rmse_deg for tested in (old, new))
    if on_new <= OUTLIER_RATIO * on_old:
        return []
    comparison = evaluation.compare(evaluation.groups(cohort, np.ones_like(is_trained)), old)
    if comparison.gap.negligible:
        return []
    return [
        "the improvement comes only from unusual new drives, on which the champion has "
        f"{on_new:.4f} deg: on its training set, {comparison}. Check them before training"
    ]


def threshold_violations(
    thresholds: PublishThresholds, manifest: Manifest, champion: Manifest | None
) -> list[str]:
    """Return the thresholds that a manifest does not reach, as phrases."""
    figures, trained = manifest.cross_validation, manifest.trained_on
    start = "without the filter, its" if manifest.line_remark else "its"
    checks = [
        (
            figures.correlation < thresholds.min_correlation,
            f"{start} correlation is {figures.correlation:.4f}, below {thresholds.min_correlation}",
        ),
        (
            figures.rmse_deg > thresholds.max_rmse_deg,
            f"{start} RMSE is {figures.rmse_deg:.4f} deg, above {thresholds.max_rmse_deg} deg",
        ),
    ]
    share = thresholds.min_part_of_champion if champion else 0.0
    before = champion.trained_on if champion else trained
    for count, noun, minimum, reference in (
        (trained.drives, "drive", thresholds.min_drives, before.drives),
        (trained.vehicles, "car", thresholds.min_vehicles, before.vehicles),
    ):
        required = max(minimum, math.ceil(share * reference))
        text = f"it was trained on {pluralize(count, noun)}, fewer than {required:,}"
        if required > minimum:
            text += f" ({share:.0%} of the champion's {reference:,})"
        checks.append((count < required, text))
    return [text for is_violated, text in checks if is_violated]


def missing_evidence(thresholds: PublishThresholds, manifest: Manifest) -> list[str]:
    """Return why a first champion of measured drives has too many columns for its data."""
    if manifest.learned_from is not None:
        return []
    columns, trained = len(manifest.terms), manifest.trained_on
    has_prior = manifest.prior is not None and manifest.prior.weight
    max_columns, min_rows = thresholds.max_columns_per_drive, thresholds.min_rows_per_column
    checks = (
        (
            not has_prior and columns > max_columns * trained.drives,
            f"it has {columns} columns on {pluralize(trained.drives, 'drive')}, more than "
            f"{max_columns:g} a drive",
        ),
        (
            trained.rows < min_rows * columns,
            f"it was trained on {pluralize(trained.rows, 'row')}, fewer than {min_rows} for each "
            f"of its {columns} columns",
        ),
    )
    return [text for is_missing, text in checks if is_missing]


def _require_same_columns(catalog: Catalog, version: ModelVersion, feature_set: str) -> None:
    """Raise `DataError` if a feature or column of a version is defined differently now."""
    manifest, definitions = version.manifest, catalog.definitions(feature_set)
    for name, published in (manifest.features | manifest.definitions).items():
        current = None
        if name in manifest.features:
            current = catalog.rows([name]).get(name)
        elif name in catalog.inputs:
            current = definitions.get(name) or catalog.definition(name)
        if current != published:
            raise DataError(f"the column {name} has changed since {version.reference}.")


@dataclass(frozen=True)
class Review:
    """Result of a review.

    Attributes
    ----------
    problems
        Reasons to refuse the challenger.
    compared
        The comparison as a phrase.
    is_significantly_worse
        True if the champion is better, though not by a refusable gap.
    """

    problems: tuple[str, ...]
    compared: str
    is_significantly_worse: bool = False

    @property
    def reason(self) -> str:
        """The problems, else the comparison, as a sentence."""
        text = "; ".join(self.problems) or self.compared
        return f"{text[:1].upper()}{text[1:]}."


def review_challenger(
    registry: Registry,
    champion: ModelVersion | None,
    manifest: Manifest,
    selection: Selection,
) -> Review:
    """Compare a challenger with the thresholds and the champion."""
    catalog = selection.cohort.catalog
    thresholds = load_thresholds(catalog.configs)
    problems = threshold_violations(thresholds, manifest, champion.manifest if champion else None)
    if champion is None:
        return Review(tuple(problems), "It is the first version")
    if _has_another_line(catalog, champion, selection.cohort.feature_set):
        # Its columns are in no Gram row of this feature set: compare cross-validated RMSEs.
        old, new = (m.cross_validation.rmse_deg for m in (champion.manifest, manifest))
        compared = (
            f"its first-stage model was fitted again; its cross-validated RMSE is {new:.4f} deg, "
            f"that of {champion.reference} was {old:.4f} deg"
        )
        problems += [compared] if new > old + thresholds.tolerance_deg else []
        return Review(tuple(problems), compared)
    try:
        evaluation = ChallengerEvaluation.prepare(selection, champion)
        groups = evaluation.groups(selection.cohort)
        comparison = evaluation.compare(groups, groups)
    except (DataError, QuestionError) as error:
        feature_set, _, _ = champion.manifest.trained_on.feature_set.partition("-")
        problems.append(
            f"the champion {champion.reference} cannot be compared: {str(error).rstrip('.')} (its "
            f"feature set is {feature_set}; choose a model list that has this set: --models LIST)"
        )
        return Review(tuple(problems), "")
    try:
        cohort, is_trained = _split_drives(registry, selection, champion)
        has_both = is_trained.any() and not is_trained.all()
        if has_both and not comparison.gap.negligible:
            comparison = _compare_unseen(evaluation, cohort, is_trained) or comparison
        problems += _comparison_problems(comparison, champion, manifest)
        if has_both and not problems:
            problems += _unusual_drives(evaluation, cohort, is_trained)
    except StorageError as error:
        problems.append(f"no comparison on the champion's training set: {error}")
    except DataError as error:
        problems += _comparison_problems(comparison, champion, manifest)
        LOGGER.warning("new drives were not compared with those of the champion: %s", error)
    return Review(tuple(problems), str(comparison), comparison.is_significantly_worse)


def _has_another_line(catalog: Catalog, version: ModelVersion, feature_set: str) -> bool:
    """Return True if a version has the same set with another first-stage model."""
    model = catalog.first_stage_model(feature_set)
    identity = version.manifest.trained_on.feature_set
    if model is None or identity == catalog.identity(feature_set):
        return False
    return identity.startswith(feature_set.removesuffix(model.digest))


def _comparison_problems(
    comparison: Comparison, champion: ModelVersion, manifest: Manifest
) -> list[str]:
    """Return the reasons to refuse that a comparison on held-out rows gives."""
    problems, name = [], champion.reference
    if comparison.champion.pooled.correlation < 0:
        problems.append(
            f"the label has the opposite sign of the estimates of {name}. Is it reversed? "
            f"{comparison}"
        )
    if not comparison.gap.negligible:
        problems.append(f"it is worse than the champion: {comparison}")
    old = champion.manifest.cross_validation.rmse_deg
    new = comparison.champion.pooled.rmse_deg
    has_reference = champion.manifest.learned_from is None and manifest.learned_from is None
    if has_reference and not problems and new > OUTLIER_RATIO * old:
        problems.append(
            f"{name} had a cross-validated RMSE of {old:.4f} deg and has {new:.4f} deg here: these "
            f"drives differ from its training set. Check them before training: {comparison}"
        )
    return problems
