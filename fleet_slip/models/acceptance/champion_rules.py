"""What a model must be before it becomes champion: above a floor, and no worse than the champion.

Both are asked of rows that the challenger was not fitted on, and on which its columns were not
chosen: a search is made again without them, for as many columns. The champion is what cars have:
its own coefficients, not its signals fitted anew. It is compared on the same held-out drives, so
that the error that counts is that of the difference, over what is independent in the data: cars
where there are several, else drives. And so that many small steps do not lead downhill, the best of
the champions so far is compared as well.

Rows do not decide alone: a car that sends its rows may say that they are many. Where cars are held
out, the median group of them must not be worse off either, each group having one vote.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from typing import Any

from pydantic import Field

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import Config, load_config
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.models.estimates.counts_model import counts_model
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.regression.choice.winner import Shortfall, Worth, compare_paired, compare_typical
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.least_squares import LinearModel
from fleet_slip.regression.validation.crossval import (
    CrossValidation,
    Procedure,
    assemble,
    cross_validate,
    least_squares,
)
from fleet_slip.regression.validation.folds import Folds
from fleet_slip.resources import config_file
from fleet_slip.selection.search import searching
from fleet_slip.selection.select_models import Selection
from fleet_slip.words import number_of


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


@cache
def floor() -> Floor:
    """Return what `publish.toml` asks for."""
    return load_config(config_file("publish.toml"), Floor)


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
        typical: the same in the median group, where cars are held out.
    """

    by: FoldKey
    challenger: CrossValidation
    incumbents: tuple[CrossValidation, ...]
    shortfalls: tuple[Shortfall, ...]
    typical: tuple[Shortfall, ...] = ()

    @property
    def better(self) -> tuple[CrossValidation, ...]:
        """Those that the challenger is worse than, over all rows or in the median group."""
        both = zip_longest(self.shortfalls, self.typical)
        return tuple(
            incumbent
            for incumbent, shortfalls in zip(self.incumbents, both, strict=True)
            if not all(one is None or one.negligible for one in shortfalls)
        )

    @property
    def drifts(self) -> bool:
        """Whether the champion is better by much more than chance, though hardly worth it."""
        first = self.shortfalls[0]
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
            f"the coefficients of {one.name} have {one.pooled.rmse_deg:.4f} deg and "
            f"{one.pooled.correlation:.4f}, difference {shortfall}"
            + (f", in the median group {typical}" if typical else "")
            for one, shortfall, typical in zip_longest(
                self.incumbents, self.shortfalls, self.typical
            )
        )
        return (
            f"on the same {number_of(challenger.rows, 'row')} of "
            f"{number_of(self.challenger.drives, 'drive')}, held out "
            f"in {len(self.challenger.folds)} groups by {self.by}, it has RMSE "
            f"{challenger.rmse_deg:.4f} deg and correlation {challenger.correlation:.4f}; {others}"
        )


@dataclass(frozen=True)
class Contest:
    """How a selection's winner is made again without what is held out, and whom it meets.

    Attributes:
        signals: all that any of them needs.
        by: what is held out, vehicle or drive.
        procedure: makes the challenger, its columns searched for anew if a search found them.
        models: those that it meets, as they are, in counts.
    """

    signals: tuple[str, ...]
    by: FoldKey
    procedure: Procedure
    models: tuple[LinearModel, ...]


def worth() -> Worth:
    """Return what a challenger may lack that is no reason to refuse it."""
    return Worth(math.radians(floor().worth_deg))


def contest(selection: Selection[Any], incumbents: Sequence[ModelVersion]) -> Contest:
    """Return how a selection's winner meets published versions, over drives with all signals.

    Raises `DataError` or `QuestionError` if the features of a version are not defined as they were.
    """
    for version in incumbents:
        _require_same_features(version)
    label, winner, found = catalogue().label, selection.winner.model, selection.searched
    searched = found is not None and winner in found.models
    inputs = found.inputs if found is not None and searched else winner.signals
    feature_set = selection.cohort.feature_set
    models = tuple(counts_model(version.manifest, feature_set) for version in incumbents)
    every = (name for model in models for name in model.signals)
    signals = tuple(dict.fromkeys((*inputs, *every)))
    cars = selection.cohort.members.count_vehicles_with((*signals, label))
    by: FoldKey = "vehicle" if cars >= LEAST_VEHICLES else "drive"
    intercept = selection.intercept
    if found is not None and searched:
        procedure = searching(found, len(winner.signals), intercept=intercept)
    else:
        procedure = least_squares(inputs, label, intercept=intercept)
    return Contest(signals, by, procedure, models)


def compare(selection: Selection[Any], incumbents: Sequence[ModelVersion]) -> Comparison:
    """Compare a selection's winner with the own coefficients of published versions.

    Raises `DataError` or `QuestionError` if no drive has the signals of all, and as `contest`.
    """
    asked = contest(selection, incumbents)
    label, name = catalogue().label, selection.winner.model.name
    folds = selection.cohort.folds(asked.by, GROUPS)
    groups = folds.serving(asked.signals, label, sparse=True)
    challenger = cross_validate(name, groups, asked.procedure, input_scales())
    others = tuple(
        as_it_is(version.reference, model, groups)
        for version, model in zip(incumbents, asked.models, strict=True)
    )
    shortfalls = tuple(compare_paired(challenger, other, worth()) for other in others)
    typical = tuple(compare_typical(challenger, other, worth()) for other in others)
    by_car = asked.by == "vehicle"
    return Comparison(asked.by, challenger, others, shortfalls, typical if by_car else ())


def as_it_is(name: str, model: LinearModel, folds: Folds) -> CrossValidation:
    """Return the figures of a published model over folds, none of which it is fitted to again."""
    tests = [error_sums(model, test) for test in folds.grams]
    return assemble(name, folds, tests, model, input_scales())


def find_faults(manifest: Manifest, champion: Manifest | None) -> list[str]:
    """Return in what a manifest is below the floor, and what it must be."""
    least, figures, trained = floor(), manifest.cross_validation, manifest.trained_on
    found = []
    if figures.correlation < least.min_correlation:
        found.append(f"its correlation is {figures.correlation:.4f}, below {least.min_correlation}")
    if figures.rmse_deg > least.max_rmse_deg:
        found.append(f"its RMSE is {figures.rmse_deg:.4f} deg, above {least.max_rmse_deg} deg")
    if trained.drives < least.min_drives:
        found.append(
            f"it was trained on {number_of(trained.drives, 'drive')}, fewer than {least.min_drives}"
        )
    if trained.vehicles is not None and trained.vehicles < least.min_vehicles:
        cars = number_of(trained.vehicles, "car")
        found.append(f"it was trained on {cars}, fewer than {least.min_vehicles}")
    if champion is not None:
        found += _shrunk(manifest, champion, least.min_part_of_champion)
    return found


def find_lacks(manifest: Manifest) -> list[str]:
    """Return of what a first champion of measured drives has too little for its columns."""
    if manifest.learned_from is not None:
        return []
    found, least = [], floor()
    columns, trained = len(manifest.terms), manifest.trained_on
    if columns > least.max_columns_per_drive * trained.drives:
        drives = number_of(trained.drives, "drive")
        most = f"{least.max_columns_per_drive:g}"
        found.append(f"it has {columns} columns on {drives}, more than {most} a drive")
    if trained.rows < least.min_rows_per_column * columns:
        rows = number_of(trained.rows, "row")
        few = f"{least.min_rows_per_column} for each of its {columns} columns"
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
        if own is not None and other is not None and own < part * other
    ]


def _require_same_features(version: ModelVersion) -> None:
    known, then = features(), version.manifest
    for name, one in then.features.items():
        if known.rows([name]).get(name) != one:
            raise DataError(f"the feature {name} of {version.reference} is not defined as then.")
    for name, definition in then.definitions.items():
        if name not in known.inputs or known.definition(name) != definition:
            raise DataError(f"the column {name} of {version.reference} is not defined as then.")
