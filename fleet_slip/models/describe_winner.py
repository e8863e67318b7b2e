"""What a selection's winner is, as the manifest of a model version."""

import math
from fractions import Fraction
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.taught_cohort import TaughtCohort
from fleet_slip.models.manifest import (
    CrossValidated,
    LearnedFrom,
    Manifest,
    ModelLabel,
    ModelTerm,
    SelectedBy,
    TrainedOn,
)
from fleet_slip.models.recipe import asked_of
from fleet_slip.models.salted_drives import hash_drives
from fleet_slip.models.straight_on import StraightOn, straight_on
from fleet_slip.models.trained_drives import checksum_of_drives, pack_hashes
from fleet_slip.regression.validation.crossval import CrossValidation
from fleet_slip.selection.select_models import RequestedSelection, Selection
from fleet_slip.warehouse.condition import parse_cohort
from fleet_slip.warehouse.tables import Warehouse


def manifest_of(selection: RequestedSelection, name: str) -> Manifest:
    """Describe the winner of a selection as a manifest."""
    signals = catalogue()
    winner = selection.winner.model
    label = signals[signals.label]
    wanted = (*winner.signals, signals.label)
    drives = drives_of(selection, name)
    beside = rows_beside = 0
    if isinstance(selection.cohort, TaughtCohort):
        beside, rows_beside = selection.cohort.count_others(wanted)
    return Manifest(
        name=name,
        label=ModelLabel(
            signal=signals.label, column=label.column, unit=label.unit, scale=label.scale
        ),
        intercept=winner.model.offset,
        intercept_exact=winner.model.intercept,
        through_origin=not selection.intercept,
        terms=tuple(
            _term(signal, exact)
            for signal, exact in zip(winner.signals, winner.model.coefficients, strict=True)
        ),
        cross_validation=_cross_validated(winner, selection),
        trained_on=TrainedOn(
            cohort=selection.cohort.condition.text,
            feature_set=features().identity(selection.cohort.feature_set),
            drives=winner.drives + beside,
            vehicles=selection.cohort.members.count_vehicles_with(wanted),
            drives_without_log=selection.cohort.members.count_received_with(wanted) or None,
            rows=winner.pooled.rows + rows_beside,
            logs_version=selection.cohort.logs_version,
            grams_version=selection.cohort.grams_version,
            drives_sha256=checksum_of_drives(drives),
        ),
        selected_by=SelectedBy(
            model_list=selection.model_list,
            model=winner.name,
            reason=selection.winner.reason,
            config_sha256=selection.config_sha256,
            asked=asked_of(selection),
        ),
        package_version=package_version("fleet-slip"),
    )


def with_straight_intercept(
    warehouse: Warehouse, manifest: Manifest, selection: Selection[Any]
) -> Manifest:
    """Return a manifest with the intercept that changes do not tell, if changes taught its model.

    One through the origin keeps 0, of no cars. Raises `DataError` if the cars do not tell their
    sensors' offsets.
    """
    name = features().name_of(manifest.trained_on.feature_set)
    change_s = features().feature_set(name).change_s
    if not change_s:
        return manifest
    found = StraightOn(Fraction(0), {}, None, 0.0, 0)
    if not manifest.through_origin:
        found = straight_on(warehouse, parse_cohort(manifest.trained_on.cohort), manifest)
    weight = selection.cohort.weight if isinstance(selection.cohort, TaughtCohort) else None
    learned = LearnedFrom(
        label="course" if weight is None else "course+sideslip",
        weight=weight,
        change_s=float(change_s[0]) if len(change_s) == 1 else tuple(map(float, change_s)),
        cars=found.cars,
        intercept_uncertainty_deg=(
            None if found.uncertainty is None else math.degrees(found.uncertainty)
        ),
        intercept_spread_deg=math.degrees(found.spread),
    )
    scales = input_scales()
    terms = (_term(column, slope / scales[column]) for column, slope in found.slopes.items())
    own = {"intercept": float(found.intercept), "intercept_exact": found.intercept}
    taught = {"learned_from": learned, "terms": (*manifest.terms, *terms)}
    return manifest.model_copy(update={**own, **taught})


def drives_of(selection: Selection[Any], name: str) -> bytes:
    """Return the salted hashes of the drives that a selection's winner was trained on, packed."""
    signals = (*selection.winner.model.signals, catalogue().label)
    return pack_hashes(hash_drives(name, selection.cohort.members.drives_with(signals)))


def _term(name: str, coefficient: Fraction) -> ModelTerm:
    known = features()
    one = known.of(name)
    definition = known.definition(name)
    return ModelTerm(
        signal=name,
        column=one.column,
        unit=one.unit,
        scale=one.scale,
        sql=known.features[name].sql if name in known.features and not definition else "",
        definition=definition,
        signal_scales=(
            {signal: catalogue()[signal].scale for signal in definition.signals}
            if definition
            else None
        ),
        coefficient=float(coefficient),
        coefficient_exact=coefficient,
    )


def _cross_validated(winner: CrossValidation, selection: RequestedSelection) -> CrossValidated:
    figures = winner.pooled
    return CrossValidated(
        folds_by=selection.folds.by,
        folds=len(winner.folds),
        correlation=figures.correlation,
        correlation_standard_error=winner.standard_error,
        rmse_deg=figures.rmse_deg,
        error_mean_deg=figures.error_mean_deg,
        error_std_deg=figures.error_std_deg,
        condition_number=winner.condition_number,
        label_noise_deg=selection.label_noise_deg,
    )
