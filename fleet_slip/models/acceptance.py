"""Conditions of a champion: thresholds, a comparison with the champion, and sound training data.

The challenger is judged on held-out rows: neither its coefficients nor its columns saw them. A
search is repeated without them for the same number of columns. The champion is compared with its
published coefficients on the same rows, so the standard error is that of a paired difference,
clustered by car, or by drive where there are few cars.
"""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
from pydantic import Field

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import pluralize
from fleet_slip.calibration.course_label import course_moments
from fleet_slip.calibration.receiver_delay import GRAIN_S, ReceiverDelay, receiver_delays
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import YAW_RATE
from fleet_slip.catalog.definitions import DELAY
from fleet_slip.catalog.signals import ALL_DRIVES
from fleet_slip.config import Config, load_config
from fleet_slip.errors import DataError, QuestionError, RefusedError, StorageError
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
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.course_relation import COLUMNS, relate
from fleet_slip.quality.plausibility import inspect_drives
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
from fleet_slip.warehouse.database import parse_cohort, parse_predicate
from fleet_slip.warehouse.gram_reader import GramReader, open_grams
from fleet_slip.warehouse.warehouse import Warehouse


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
        Unit that was held out: vehicle or drive.
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
        Unit that is held out: vehicle or drive.
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

        Raises `DataError` if no drive has them.
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
        folds = replace(folds, has_intercept=self.selection.candidate_list.intercept)
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
"""Maximum number of drives in the comparison; a larger cohort is sampled by the drives' hashes."""

_HEX = 4


OUTLIER_RATIO = 2.0
"""Drives are unusual if the champion's RMSE on them exceeds this multiple of its usual RMSE."""


@dataclass(frozen=True)
class TrainingSplit:
    """The drives of a selection, with the mask of those that the champion was trained on."""

    evaluation: ChallengerEvaluation
    cohort: Cohort
    is_trained: BoolArray

    @classmethod
    def load(
        cls, evaluation: ChallengerEvaluation, registry: Registry, champion: ModelVersion
    ) -> "TrainingSplit":
        """Split the drives. Raises `StorageError` if the champion's training set is unreadable."""
        trained_drives = registry.trained_drives(champion.manifest)
        cohort = evaluation.selection.cohort
        if cohort.source is not None and cohort.sums is not None:
            predicate, drives = cohort.predicate, cohort.drive_count
            if drives > MAX_REVIEWED_DRIVES:
                below = 16**_HEX * MAX_REVIEWED_DRIVES // drives
                sample = f"left(sha256('vouched ' || drive_id), {_HEX}) < '{below:0{_HEX}x}'"
                predicate &= parse_predicate(cohort.catalog.signals, sample)
            cohort = load_cohort(cohort.source, predicate, cohort.feature_set)
        is_trained = trained_drives.among(hash_names(cohort.drives["drive_id"]))
        return cls(evaluation, cohort, is_trained)

    def compare_on(self, tested: Folds) -> Comparison:
        """Compare on drives of the cohort, without whose groups the challenger is trained."""
        groups = self.evaluation.groups(self.cohort, np.ones_like(self.is_trained))
        return self.evaluation.compare(groups, tested)

    def compare_unseen(self) -> Comparison | None:
        """Compare on drives outside the training of the champion, where it has no advantage.

        Returns None if these are all drives, or of fewer than `MIN_VEHICLES` groups.
        """
        with contextlib.suppress(DataError):  # fewer than two groups
            unseen = self.evaluation.groups(self.cohort, ~self.is_trained)
            if self.is_trained.any() and len(unseen.names) >= MIN_VEHICLES:
                return replace(self.compare_on(unseen), unseen=True)
        return None

    def problems(self) -> list[str]:
        """Return a reason to refuse a challenger that is better on unusual new drives alone.

        Trained on a part of them it is better on the others, and worse on the champion's.
        """
        with contextlib.suppress(DataError):  # fewer than two groups
            trained = self.evaluation.groups(self.cohort, self.is_trained)
            unseen = self.evaluation.groups(self.cohort, ~self.is_trained)
            old, new = (
                self.evaluation.as_published(tested).pooled.rmse_deg for tested in (trained, unseen)
            )
            if new > OUTLIER_RATIO * old:
                comparison = self.compare_on(trained)
                if not comparison.gap.negligible:
                    return [
                        "the improvement comes only from unusual new drives, on which the champion "
                        f"has {new:.4f} deg: on its training set, {comparison}. Check the new "
                        "drives before training"
                    ]
        return []


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
        split = TrainingSplit.load(evaluation, registry, champion)
        comparison = split.compare_unseen()
        if comparison is None:
            groups = evaluation.groups(selection.cohort)
            comparison = evaluation.compare(groups, groups)
    except StorageError as error:
        problems.append(f"no comparison without the champion's training set: {error}")
        return Review(tuple(problems), "")
    except (DataError, QuestionError) as error:
        feature_set, _, _ = champion.manifest.trained_on.feature_set.partition("-")
        problems.append(
            f"the champion {champion.reference} cannot be compared: {str(error).rstrip('.')} (its "
            f"feature set is {feature_set}; choose a model list that has this set: --models LIST)"
        )
        return Review(tuple(problems), "")
    problems += _comparison_problems(comparison, champion, manifest)
    if not problems:
        problems += split.problems()
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


# Checks of the training data: drives and courses that a car can have. A fault of all drives, such
# as a reversed label, shows in no comparison of drives.

MAX_DRIVES = 5
"""Drives to inspect, each of a different vehicle where possible."""
WRONG_MAPPING = ("late", "magnitude", "reversed", "scaled", "swapped")
"""Kinds of faults of the mapping. If most drives of a first champion have one, no drive shows the
correct value, and later models may use the signal."""
MIN_NEW_DRIVES = 3
"""Fewest new drives to judge beside a champion: one alone may be odd."""


def require_sound_drives(warehouse: Warehouse, registry: Registry, manifest: Manifest) -> None:
    """Raise `RefusedError` if most of the inspected measured drives contradict the motion of cars.

    Faults of the label and of signals in columns of the model count. For a first champion wrong
    mappings of all other signals do, too. Beside a champion only drives that it was not trained on
    are inspected; a model of more columns than the champion needs as much data as a first one.
    """
    champion = registry.champion(manifest.name)
    champion_drives = registry.trained_drives(champion.manifest) if champion else None

    def select_new(drives: Sequence[str]) -> Sequence[bool]:
        if champion_drives is None:
            return [True] * len(drives)
        names = hash_names(pa.array(drives, pa.string()))
        return [not is_trained for is_trained in champion_drives.among(names).tolist()]

    predicate = parse_predicate(warehouse.catalog.signals, manifest.trained_on.cohort)
    inspection = inspect_drives(warehouse, predicate, MAX_DRIVES, select_new)
    if inspection.measured and not manifest.learned_from:
        champion_columns = len(champion.manifest.terms) if champion else 0
        _require_evidence(load_thresholds(warehouse.configs), manifest, champion_columns)
    inspected = len(inspection.drives)
    if champion and inspected < MIN_NEW_DRIVES:
        return
    used = {manifest.label.signal}.union(*(term.inputs for term in manifest.terms))
    for (kind, signals), faults in inspection.by_fault().items():
        counts = not used.isdisjoint(signals) or (kind in WRONG_MAPPING and not champion)
        # Drives of a champion have no faults, so that half of the new ones are enough beside it.
        if counts and 2 * len(faults) + bool(champion) > inspected:
            raise RefusedError(
                f"{manifest.name} was not published: {len(faults)} of {inspected} inspected drives "
                f"contradict the motion of any car: {faults[0]} Correct the mapping and run: "
                "fleet-slip ingest LOGS --mapping M --replace. To publish it anyway: --force"
            )


def _require_evidence(
    thresholds: PublishThresholds, manifest: Manifest, champion_columns: int
) -> None:
    """Raise `RefusedError` if a model of more columns than its champion has too little data."""
    columns, trained = len(manifest.terms), manifest.trained_on
    has_prior = manifest.prior is not None and manifest.prior.weight
    max_columns, min_rows = thresholds.max_columns_per_drive, thresholds.min_rows_per_column
    if columns <= champion_columns:
        return
    if not has_prior and columns > max_columns * trained.drives:
        reason = f"{pluralize(trained.drives, 'drive')}, more than {max_columns:g} a drive"
    elif trained.rows < min_rows * columns:
        rows = pluralize(trained.rows, "row")
        reason = f"{rows}, fewer than {min_rows} for each of its {columns} columns"
    else:
        return
    raise RefusedError(
        f"{manifest.name} was not published: it has {columns} columns on {reason}. Ingest more "
        "drives or choose fewer columns. To publish it anyway: --force"
    )


# A late course looks like a side-slip angle in all figures, and so does a heading.

MAX_ANGLE_ERROR_DEG = 0.15
"""Error of the label that an unknown or remaining delay may cause: as much as the intercept has
from the mounting of reference sensors (`calibration.course_label`)."""
USUAL_YAW_RATE_RAD_S = 0.25
"""Standard deviation of the yaw rate of cars without moments of the course."""
MAX_CARS = 5
"""Maximum number of cars in a message."""


def require_sound_course(warehouse: Warehouse, manifest: Manifest) -> None:
    """Raise `RefusedError` for a course that is late, or implausible for a car.

    A course that is late by d shifts the label by d times the yaw rate.
    """
    predicate = parse_cohort(warehouse.catalog.signals, manifest.trained_on.cohort)
    with GramReader(warehouse) as reader:
        drives = course_moments(reader, predicate)
    moments = {car: np.sum(list(of_car.values()), axis=0) for car, of_car in drives.items()}
    yaw_rates = {car: _yaw_rate_rad_s(of_car) for car, of_car in moments.items()}
    delays_s = _require_in_time(warehouse, manifest, yaw_rates)
    _require_course_of_cars(manifest, moments, delays_s)


def _yaw_rate_rad_s(moments: FloatArray) -> float:
    """Return the standard deviation of the yaw rate: that of its changes over the root of two."""
    at = 1 + COLUMNS.index(YAW_RATE)
    changes, total, square = moments[0, 0], moments[0, at], moments[at, at]
    return math.sqrt(max(square / changes - (total / changes) ** 2, 0.0) / 2)


def _require_in_time(
    warehouse: Warehouse, manifest: Manifest, yaw_rates: Mapping[str, float]
) -> dict[str, float]:
    """Return the remaining delays of courses in Gram rows, in s, by car of the training drives.

    Raises `RefusedError` unless all are estimated and corrected, `DataError` without Gram rows.
    """
    signals = warehouse.catalog.signals
    predicate = parse_cohort(signals, manifest.trained_on.cohort)
    with open_grams(warehouse, DELAY, predicate) as opened:
        batches = opened.batches(parse_predicate(signals, ALL_DRIVES))
        delays = receiver_delays(batches).cars
    feature_set = warehouse.catalog.name_of(manifest.trained_on.feature_set)
    with open_grams(warehouse, feature_set, predicate) as opened:
        cars = dict(opened.course_delays(predicate))
    remaining = {
        car: max((delays[car].value - GRAIN_S * parts for parts in corrected), key=abs)
        for car, corrected in cars.items()
        if car in delays
    }

    def is_large(car: str, delay_s: float | None) -> bool:
        yaw_rate = yaw_rates.get(car, USUAL_YAW_RATE_RAD_S)
        return delay_s is None or math.degrees(abs(delay_s) * yaw_rate) > MAX_ANGLE_ERROR_DEG

    unsure = [car for car in remaining if is_large(car, delays[car].uncertainty)]
    late = [car for car, delay_s in remaining.items() if is_large(car, delay_s)]
    problems = []
    if unsure:
        problems.append(
            f"delays are too uncertain ({_named(delays, unsure)}; they may cause more than "
            f"{MAX_ANGLE_ERROR_DEG:g} deg)"
        )
    if unknown := len(cars) - len(remaining):
        problems.append(f"that of {pluralize(unknown, 'car')} cannot be estimated")
    if late:
        problems.append(
            f"Gram rows are corrected by an outdated delay ({_named(delays, late)}): run "
            "fleet-slip gram --features course, and send the new delay to cars that count on board"
        )
    if problems:
        raise RefusedError(
            f"{manifest.name} was not published: a late course looks like side-slip, and "
            f"{'; '.join(problems)}. See: fleet-slip calibrate --car NAME. Choose other cars, add "
            "drives, or set the receiver type (receiver in the mapping). To publish it anyway: "
            f"fleet-slip publish {manifest.name} --label course --force"
        )
    return remaining


def _named(delays: Mapping[str, ReceiverDelay], cars: Sequence[str]) -> str:
    more = f", and {len(cars) - MAX_CARS} more" if len(cars) > MAX_CARS else ""
    return ", ".join(f"{car}: {delays[car]}" for car in cars[:MAX_CARS]) + more


def _require_course_of_cars(
    manifest: Manifest, moments: Mapping[str, FloatArray], delays_s: Mapping[str, float]
) -> None:
    """Raise `RefusedError` if a course, `delays_s` late in Gram rows, is not that of a car."""
    faults: dict[str, Fault] = {}
    for car, of_car in sorted(moments.items()):
        relation = relate(of_car, delays_s.get(car, 0.0))
        if relation and (fault := relation.fault or relation.misplaced):
            faults[car] = fault
    if not faults:
        return
    (car, fault), *remaining = faults.items()
    more = f", and {pluralize(len(remaining), 'other car')}" if remaining else ""
    raise RefusedError(
        f"{manifest.name} was not published: the course of {len(faults)} of "
        f"{pluralize(len(moments), 'car')} is implausible ({car}: {fault.figure}{more}). "
        f"{fault.remedy} Then ingest again, or choose other cars; fleet-slip quality lists the "
        f"drives. To publish it anyway: fleet-slip publish {manifest.name} --label course --force"
    )
