"""Whether a challenger is better on the drives that vouch for the champion, or on odd ones alone.

A challenger that has learned from odd drives is better on them, held out or not, and where they are
many that outweighs what it loses elsewhere. So where the champion meets new drives on which it is
much more wrong than on those that made it, both are compared on these alone.
"""

from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.fold_sums import SummedCohort
from fleet_slip.grams.cohorts.folding import FOLD_KEYS, assign_folds
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.grams.cohorts.taught_cohort import TaughtCohort
from fleet_slip.grams.rows.gram_rows import hash_numbers
from fleet_slip.models.acceptance.champion_rules import GROUPS, Contest, as_it_is, contest, worth
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.regression.choice.winner import compare_paired
from fleet_slip.regression.validation.crossval import CrossValidation, assemble, held_out_errors
from fleet_slip.regression.validation.folds import CohortFolds, FoldAssignment, Folds
from fleet_slip.runs.log import LOGGER
from fleet_slip.selection.select_models import Selection
from fleet_slip.warehouse.condition import parse_condition

ODD = 2.0
"""Drives on which the champion's error is so many times that on the others are odd."""

MOST_DRIVES = 20_000
"""Of a larger cohort so many drives, chosen by their hash, are judged."""

_HEX = 4


def odd_gain(registry: Registry, selection: Selection[Any], champion: ModelVersion) -> str | None:
    """Return why a person must look first: it is better on odd new drives alone; else None.

    Nothing is said where changes of the course taught, or all drives are as known as the others.
    Raises `StorageError` if which drives made the champion cannot be read.
    """
    made = registry.trained_drives(champion.manifest)
    if made is None or isinstance(selection.cohort, TaughtCohort):
        return None
    try:
        cohort = _some_drives(selection)
        known = made.among(hash_numbers(cohort.drives["drive_id"]))
        if known.any() and not known.all():
            return _compare(selection, champion, cohort, known)
    except DataError as error:
        LOGGER.warning("whether it is better on odd drives alone was not judged: %s", error)
    return None


def _some_drives(selection: Selection[Any]) -> Cohort:
    cohort: Cohort | SummedCohort = selection.cohort
    if isinstance(cohort, Cohort):
        return cohort
    condition, drives = cohort.condition, cohort.drive_count
    if drives > MOST_DRIVES:
        below = 16**_HEX * MOST_DRIVES // drives
        chosen = f"left(sha256('vouched ' || drive_id), {_HEX}) < '{below:0{_HEX}x}'"
        condition &= parse_condition(chosen)
    return load_cohort(cohort.source, condition, cohort.feature_set)


def _compare(
    selection: Selection[Any], champion: ModelVersion, cohort: Cohort, known: BoolArray
) -> str | None:
    asked = contest(selection, [champion])
    every = np.ones(len(known), dtype=np.bool_)
    groups, old, new = (_folds(cohort, asked, mask) for mask in (every, known, ~known))
    incumbent = as_it_is(champion.reference, asked.models[0], old)
    on_new = as_it_is(champion.reference, asked.models[0], new).pooled.rmse_deg
    if on_new <= ODD * incumbent.pooled.rmse_deg:
        return None
    challenger = _held_out(selection.winner.model.name, asked, groups, old)
    shortfall = compare_paired(challenger, incumbent, worth())
    if shortfall.negligible:
        return None
    return (
        f"it is better on odd drives alone: on the drives that made {champion.reference} it has "
        f"{challenger.pooled.rmse_deg:.4f} deg where the champion has "
        f"{incumbent.pooled.rmse_deg:.4f} deg, difference {shortfall}, and on the new ones the "
        f"champion has {on_new:.4f} deg. Look at these before they teach"
    )


def _held_out(name: str, asked: Contest, groups: Folds, old: Folds) -> CrossValidation:
    """Cross-validate over all groups, tested on the drives of each that made the champion."""
    training = dict(zip(groups.names, (train for train, _ in groups.splits()), strict=True))
    tests = [
        held_out_errors(asked.procedure(training[fold]), training[fold], test)
        for fold, test in zip(old.names, old.grams, strict=True)
    ]
    return assemble(name, old, tests, asked.procedure(groups.total), input_scales())


def _folds(cohort: Cohort, asked: Contest, wanted: BoolArray) -> Folds:
    """Return some drives in the groups that the whole cohort has. Raises `DataError`."""
    values = cohort.drives[FOLD_KEYS[asked.by]].to_pylist()
    whole = assign_folds(values, asked.by, GROUPS)
    used, fold = np.unique(whole.fold[wanted], return_inverse=True)
    names = tuple(whole.names[number] for number in used.tolist())
    part = cohort.part(wanted)
    folds = CohortFolds.of(part.tables, FoldAssignment(fold, names), part.drive_numbers)
    return folds.serving(asked.signals, catalogue().label, sparse=True)
