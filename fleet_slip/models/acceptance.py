"""What a model must be before it becomes champion: above a floor, and no worse than the champion.

Both are asked of rows that the challenger was not fitted on, and on which its columns were not
chosen: a search is made again without them, for as many columns. The champion is what cars have:
its own coefficients, not its signals fitted anew. It is compared on the same held-out drives, so
that the error that counts is that of the difference, over what is independent in the data: cars
where there are several, else drives. And so that many small steps do not lead downhill, the best of
the champions so far is compared as well.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from fleet_slip.arrays import BoolArray
from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.config import Config, load_config
from fleet_slip.errors import DataError, QuestionError, RefusedError, StorageError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.folding import FOLD_KEYS, FoldKey, assign_folds
from fleet_slip.grams.gram_files import hash_names
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import CHAMPION, ModelVersion, Registry
from fleet_slip.models.search import searching
from fleet_slip.models.select import Selection
from fleet_slip.regression.choice import RmseGap, Tolerance, compare_paired
from fleet_slip.regression.figures import error_sums
from fleet_slip.regression.folds import (
    CohortFolds,
    CrossValidation,
    FoldAssignment,
    Folds,
    Procedure,
    assemble,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.least_squares import LinearModel
from fleet_slip.resources import Configs
from fleet_slip.storage.runs import LOGGER
from fleet_slip.warehouse.predicate import parse_predicate


class Floor(Config):
    """What a person asks of every champion; `configs/publish.toml` says what each means."""

    min_correlation: float = Field(gt=-1, lt=1)
    max_rmse_deg: float = Field(gt=0)
    min_drives: int = Field(ge=1)
    min_vehicles: int = Field(ge=1)
    min_part_of_champion: float = Field(ge=0, le=1)
    worth_deg: float = Field(ge=0)
    max_columns_per_drive: float = Field(default=3.0, gt=0)
    min_rows_per_column: int = Field(default=100, ge=1)

    @property
    def worth(self) -> Tolerance:
        """What a challenger may lack that is no reason to refuse it."""
        return Tolerance(math.radians(self.worth_deg))


def load_floor(configs: Configs) -> Floor:
    """Read `publish.toml`. Raises `ConfigError`."""
    return load_config(configs.file("publish.toml"), Floor)


LEAST_VEHICLES = 5
"""With fewer cars their difference says little of other cars, and drives are held out instead."""

SURE = 3.0
"""So many standard errors worse is no chance: a champion does not give way to that."""

GROUPS = 20
"""Into so many groups, or fewer, cars or drives are dealt. Each is an exact fit."""


@dataclass(frozen=True)
class Comparison:
    """A challenger and the own coefficients of published versions on the same held-out rows.

    Attributes:
        by: what was held out, vehicle or drive.
        challenger: fitted to all groups but the one that it is tested on, its columns searched for
            there if a search found them.
        incumbents: the champion, and the best of the champions so far if that is another one.
        shortfalls: of the challenger, from each of them, over all rows.
        unseen: whether all these rows are of drives that made no incumbent.
    """

    by: FoldKey
    challenger: CrossValidation
    incumbents: tuple[CrossValidation, ...]
    gaps: tuple[RmseGap, ...]
    unseen: bool = False

    @property
    def better(self) -> tuple[CrossValidation, ...]:
        """The incumbents that the challenger is worse than."""
        return tuple(
            incumbent
            for incumbent, shortfall in zip(self.incumbents, self.gaps, strict=True)
            if not shortfall.negligible
        )

    @property
    def drifts(self) -> bool:
        """Whether the champion is better by much more than chance, though hardly worth it."""
        first = self.gaps[0]
        enough = len(self.challenger.folds) >= LEAST_VEHICLES
        return enough and first.rmse > SURE * first.standard_error

    @property
    def contradicted(self) -> bool:
        """Whether a published version estimates the opposite of the label."""
        return any(one.pooled.correlation < 0 for one in self.incumbents)

    @property
    def best(self) -> str | None:
        """The incumbent that is better than all others and the challenger; None if none is."""
        first = min(self.incumbents, key=lambda one: one.pooled.rmse)
        return first.name if first.pooled.rmse < self.challenger.pooled.rmse else None

    def __str__(self) -> str:
        challenger = self.challenger.pooled
        others = "; ".join(
            f"{one.name} as published has {one.pooled.rmse_deg:.4f} deg and "
            f"{one.pooled.correlation:.4f}, difference {shortfall}"
            for one, shortfall in zip(self.incumbents, self.gaps, strict=True)
        )
        return (
            f"on the same {pluralize(challenger.rows, 'row')} of "
            f"{pluralize(self.challenger.drives, 'drive')}"
            f"{' that are new to both' if self.unseen else ''}, held out "
            f"in {len(self.challenger.folds)} groups by {self.by}, it has RMSE "
            f"{challenger.rmse_deg:.4f} deg and correlation {challenger.correlation:.4f}; {others}"
        )


@dataclass(frozen=True)
class Contest:
    """How a selection's winner is made again without what is held out, and whom it meets.

    Attributes:
        name: the winner's.
        signals: all that any of them needs.
        by: what is held out, vehicle or drive.
        procedure: makes the challenger, its columns searched for anew if a search found them.
        incumbents: those that it meets, by reference, as they are, in counts.
        worth: what the challenger may lack.
    """

    catalog: Catalog
    name: str
    signals: tuple[str, ...]
    by: FoldKey
    procedure: Procedure
    incumbents: dict[str, LinearModel]
    worth: Tolerance

    def serving(self, folds: CohortFolds) -> Folds:
        """Return the folds of drives with all signals. Raises `DataError` without."""
        return folds.serving(self.signals, self.catalog.signals.label, sparse=True)

    def part(self, cohort: Cohort, wanted: BoolArray) -> Folds:
        """Return some drives in the groups that the whole cohort has. Raises `DataError`."""
        values = cohort.drives[FOLD_KEYS[self.by]].to_pylist()
        whole = assign_folds(values, self.by, GROUPS)
        used, fold = np.unique(whole.fold[wanted], return_inverse=True)
        names = tuple(whole.names[number] for number in used.tolist())
        part = cohort.part(wanted)
        assignment = FoldAssignment(fold, names)
        return self.serving(CohortFolds.from_tables(part.tables, assignment, part.drive_numbers))

    def on(self, groups: Folds, tested: Folds) -> Comparison:
        """Compare, the challenger made without each of `groups`, on what `tested` has of it."""
        tests = dict(zip(tested.names, tested.grams, strict=True))
        sums = [
            held_out_errors(self.procedure(training), training, tests[name])
            for name, (training, _) in zip(groups.names, groups.splits(), strict=True)
            if name in tests
        ]
        whole = self.procedure(groups.total)
        challenger = assemble(self.name, tested, sums, whole, self.catalog.input_scales)
        incumbents = tuple(
            as_it_is(self.catalog, *incumbent, tested) for incumbent in self.incumbents.items()
        )
        gaps = tuple(compare_paired(challenger, one, self.worth) for one in incumbents)
        return Comparison(self.by, challenger, incumbents, gaps)


def contest_of(selection: Selection, incumbents: Sequence[ModelVersion]) -> Contest:
    """Return how a selection's winner meets published versions, over drives with all signals.

    Raises `DataError` or `QuestionError` if the features of a version are not defined as they were.
    """
    catalog, feature_set = selection.cohort.catalog, selection.cohort.feature_set
    for version in incumbents:
        _require_same_features(catalog, version, feature_set)
    winner, found = selection.winner.model, selection.searched_winner
    label = catalog.signals.label
    inputs = found.inputs if found is not None else winner.signals
    models = {one.reference: one.manifest.counts_model(catalog, feature_set) for one in incumbents}
    every = (name for model in models.values() for name in model.signals)
    signals = tuple(dict.fromkeys((*inputs, *every)))
    cars = selection.cohort.count_vehicles_with((*signals, label))
    by: FoldKey = "vehicle" if cars >= LEAST_VEHICLES else "drive"
    intercept = selection.intercept
    if found is not None:
        procedure = searching(label, found, len(winner.signals), intercept=intercept)
    else:
        procedure = least_squares(inputs, label, intercept=intercept)
    worth = load_floor(catalog.configs).worth
    return Contest(catalog, winner.name, signals, by, procedure, models, worth)


def compare(selection: Selection, incumbents: Sequence[ModelVersion]) -> Comparison:
    """Compare a selection's winner with the own coefficients of published versions.

    Raises `DataError` or `QuestionError` if no drive has the signals of all, and as `contest`.
    """
    contest = contest_of(selection, incumbents)
    groups = contest.serving(selection.cohort.folds(contest.by, GROUPS))
    return contest.on(groups, groups)


def compare_unseen(
    registry: Registry, selection: Selection, incumbents: Sequence[ModelVersion]
) -> Comparison | None:
    """Compare on the drives alone that made no incumbent: on its own ones it has an advantage.

    None if these are none, all, or of fewer groups than `LEAST_VEHICLES`. Raises as `compare`, and
    `StorageError` if which drives made an incumbent cannot be read.
    """
    if (divided := _divide(registry, selection, incumbents)) is None:
        return None
    cohort, known = divided
    contest = contest_of(selection, incumbents)
    groups, new = (contest.part(cohort, mask) for mask in (np.ones_like(known), ~known))
    if len(new.names) < LEAST_VEHICLES:
        return None
    return replace(contest.on(groups, new), unseen=True)


MOST_DRIVES = 20_000
"""Of a larger cohort so many drives, chosen by their hash, are judged."""

_HEX = 4


def _divide(
    registry: Registry, selection: Selection, versions: Sequence[ModelVersion]
) -> tuple[Cohort, BoolArray] | None:
    """Return a selection's cohort, and which of its drives made any of some versions.

    None if all or none did. Raises `StorageError` if which these are cannot be read.
    """
    made = [registry.trained_drives(one.manifest) for one in versions]
    cohort = selection.cohort
    if cohort.source is not None and cohort.sums is not None:
        predicate, drives = cohort.predicate, cohort.drive_count
        if drives > MOST_DRIVES:
            below = 16**_HEX * MOST_DRIVES // drives
            chosen = f"left(sha256('vouched ' || drive_id), {_HEX}) < '{below:0{_HEX}x}'"
            predicate &= parse_predicate(cohort.catalog.signals, chosen)
        cohort = load_cohort(cohort.source, predicate, cohort.feature_set)
    numbers = hash_names(cohort.drives["drive_id"])
    known = np.any([one.among(numbers) for one in made], axis=0)
    return (cohort, known) if known.any() and not known.all() else None


def as_it_is(catalog: Catalog, name: str, model: LinearModel, folds: Folds) -> CrossValidation:
    """Return the figures of a published model over folds, none of which it is fitted to again."""
    tests = [error_sums(model, test) for test in folds.grams]
    return assemble(name, folds, tests, model, catalog.input_scales)


def find_faults(floor: Floor, manifest: Manifest, champion: Manifest | None) -> list[str]:
    """Return in what a manifest is below the floor, and what it must be."""
    figures, trained = manifest.cross_validation, manifest.trained_on
    found = []
    if figures.correlation < floor.min_correlation:
        found.append(f"its correlation is {figures.correlation:.4f}, below {floor.min_correlation}")
    if figures.rmse_deg > floor.max_rmse_deg:
        found.append(f"its RMSE is {figures.rmse_deg:.4f} deg, above {floor.max_rmse_deg} deg")
    if trained.drives < floor.min_drives:
        found.append(
            f"it was trained on {pluralize(trained.drives, 'drive')}, fewer than {floor.min_drives}"
        )
    if trained.vehicles < floor.min_vehicles:
        cars = pluralize(trained.vehicles, "car")
        found.append(f"it was trained on {cars}, fewer than {floor.min_vehicles}")
    if champion is not None:
        found += _shrunk(manifest, champion, floor.min_part_of_champion)
    return found


def find_lacks(floor: Floor, manifest: Manifest) -> list[str]:
    """Return of what a first champion of measured drives has too little for its columns."""
    if manifest.learned_from is not None:
        return []
    found = []
    columns, trained = len(manifest.terms), manifest.trained_on
    own_rows_only = manifest.prior is None or not manifest.prior.weight
    if own_rows_only and columns > floor.max_columns_per_drive * trained.drives:
        drives = pluralize(trained.drives, "drive")
        most = f"{floor.max_columns_per_drive:g}"
        found.append(f"it has {columns} columns on {drives}, more than {most} a drive")
    if trained.rows < floor.min_rows_per_column * columns:
        rows = pluralize(trained.rows, "row")
        few = f"{floor.min_rows_per_column} for each of its {columns} columns"
        found.append(f"it was trained on {rows}, fewer than {few}")
    return found


def _shrunk(manifest: Manifest, champion: Manifest, part: float) -> list[str]:
    """Return of what a model was trained on too little beside the champion."""
    pairs = (
        ("drives", manifest.trained_on.drives, champion.trained_on.drives),
        ("cars", manifest.trained_on.vehicles, champion.trained_on.vehicles),
    )
    return [
        f"it was trained on {own:,} {what}, less than {part:.0%} of the champion's {other:,}"
        for what, own, other in pairs
        if own < part * other
    ]


def _has_another_line(catalog: Catalog, version: ModelVersion, feature_set: str) -> bool:
    """Whether a version has the same set with another line: its columns are in no Gram row here."""
    line, then = catalog.first_stage_model(feature_set), version.manifest.trained_on.feature_set
    if line is None or then == catalog.identity(feature_set):
        return False
    return then.startswith(feature_set.removesuffix(line.digest))


def _require_same_features(catalog: Catalog, version: ModelVersion, feature_set: str) -> None:
    then = version.manifest
    of_set = catalog.definitions(feature_set)
    for name, feature in then.features.items():
        if catalog.rows([name]).get(name) != feature:
            raise DataError(f"the feature {name} has changed since {version.reference}.")
    for name, definition in then.definitions.items():
        now = of_set.get(name) or catalog.definition(name) if name in catalog.inputs else None
        if now != definition:
            raise DataError(f"the column {name} has changed since {version.reference}.")


# A challenger that was trained on unusual drives is better on them, held out or not. Where the
# champion's error on new drives is much larger than on those that made it, both are compared on the
# latter alone.

ODD = 2.0
"""Drives on which the champion's error is so many times that on the others are odd."""


def odd_gain(registry: Registry, selection: Selection, champion: ModelVersion) -> str | None:
    """Return why a person must look first: it is better on odd new drives alone; else None.

    Nothing is said where all drives are as known as the others. Raises `DataError` if there are too
    few of either, and `StorageError` if which drives made the champion cannot be read.
    """
    if (divided := _divide(registry, selection, [champion])) is None:
        return None
    cohort, known = divided
    contest = contest_of(selection, [champion])
    groups, old, new = (contest.part(cohort, mask) for mask in (np.ones_like(known), known, ~known))
    (model,) = contest.incumbents.items()
    on_old, on_new = (as_it_is(contest.catalog, *model, folds).pooled for folds in (old, new))
    if on_new.rmse_deg <= ODD * on_old.rmse_deg:
        return None
    found = contest.on(groups, old)
    (shortfall,) = found.gaps
    if shortfall.negligible:
        return None
    return (
        "the improvement comes only from unusual new drives: on the training set of "
        f"{champion.reference} it has {found.challenger.pooled.rmse_deg:.4f} deg and the champion "
        f"{on_old.rmse_deg:.4f} deg, difference {shortfall}; on the new drives the champion has "
        f"{on_new.rmse_deg:.4f} deg. Check these before training"
    )


@dataclass(frozen=True)
class Judgement:
    """What the rules say of a challenger.

    Attributes:
        problems: why it is not to become champion.
        compared: with what it was compared.
        best: the number of a champion of before that is better than it; None if none is.
        drifts: whether the champion is better for sure, if not by what is worth a refusal.
    """

    problems: tuple[str, ...]
    compared: str
    best: int | None = None
    drifts: bool = False

    @property
    def reason(self) -> str:
        """The problems, else what was compared, as a sentence."""
        text = "; ".join(self.problems) or self.compared
        return f"{text[:1].upper()}{text[1:]}."

    def require_passed(self, name: str) -> None:
        """Raise `RefusedError` if there are problems."""
        if self.problems:
            raise RefusedError(
                f"{name} was not published: {'; '.join(self.problems)}. Check the data. To "
                "publish it anyway: --force"
            )


def judge(
    registry: Registry,
    champion: ModelVersion | None,
    manifest: Manifest,
    selection: Selection,
) -> Judgement:
    """Compare a challenger with the champion, and with the best of the champions so far."""
    catalog = selection.cohort.catalog
    floor = load_floor(catalog.configs)
    problems = find_faults(floor, manifest, champion.manifest if champion else None)
    if champion is None:
        return Judgement(tuple(problems), "It is the first version")
    if _has_another_line(catalog, champion, selection.cohort.feature_set):
        was, now = (
            champion.manifest.cross_validation.rmse_deg,
            selection.winner.model.pooled.rmse_deg,
        )
        told = (
            f"its line was fitted again; its cross-validated RMSE is {now:.4f} deg, that of "
            f"{champion.reference} was {was:.4f} deg"
        )
        problems += [told] if now > was + floor.worth_deg else []
        return Judgement(tuple(problems), told)
    try:
        incumbents = _incumbents(registry, champion)
        comparison = compare(selection, incumbents)
        if comparison.better:
            comparison = compare_unseen(registry, selection, incumbents) or comparison
    except (DataError, QuestionError) as error:
        theirs, _, _ = champion.manifest.trained_on.feature_set.partition("-")
        problems.append(
            f"the champion {champion.reference} cannot be compared: {str(error).rstrip('.')} (its "
            f"feature set is {theirs}; to compare on it: --features {theirs})"
        )
        return Judgement(tuple(problems), "")
    if comparison.contradicted:
        problems.append(
            f"the label has the opposite sign of the estimates of {champion.reference}. Is it "
            f"reversed? {comparison}"
        )
    better = [one.name for one in comparison.better]
    if champion.reference in better:
        problems.append(f"it is worse than the champion: {comparison}")
    elif better:
        problems.append(
            f"it is worse than {better[0]}, the best champion so far, after several small losses: "
            f"{comparison}. To accept the present champion as the new reference: fleet-slip "
            f"promote {champion.reference}"
        )
    then = champion.manifest
    if then.learned_from is None and manifest.learned_from is None:
        was, now = then.cross_validation.rmse_deg, comparison.incumbents[0].pooled.rmse_deg
        if now > ODD * was and not problems:
            problems.append(
                f"{champion.reference} had a cross-validated RMSE of {was:.4f} deg and has "
                f"{now:.4f} deg here: these drives differ from its training set. Check them "
                f"before training: {comparison}"
            )
    try:
        if not problems and (odd := odd_gain(registry, selection, champion)):
            problems.append(odd)
    except StorageError as error:
        problems.append(f"no comparison on the champion's training set: {error}")
    except DataError as error:
        LOGGER.warning(
            "not checked whether the improvement comes only from unusual drives: %s", error
        )
    best = next((one.version for one in incumbents if one.reference == comparison.best), None)
    return Judgement(tuple(problems), str(comparison), best, comparison.drifts)


def _incumbents(registry: Registry, champion: ModelVersion) -> list[ModelVersion]:
    """Return the champion, and the best of the champions so far if that is another version."""
    name = champion.manifest.name
    best = registry.history(name).best_of(CHAMPION)
    others = [] if best in (None, champion.version) else [registry.load(name, best)]
    return [champion, *others]
