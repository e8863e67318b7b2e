"""From a selection's winner to a published model version, unless the champion is better."""

import functools
from dataclasses import dataclass
from fractions import Fraction
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, QuestionError, RefusedError
from fleet_slip.models.manifest import (
    CrossValidated,
    Manifest,
    ModelLabel,
    ModelTerm,
    SelectedBy,
    TrainedOn,
)
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.regression.crossval import CrossValidation
from fleet_slip.selection.compare import Selection, validate
from fleet_slip.selection.model_list import CandidateModel


@dataclass(frozen=True)
class Publication:
    """What publishing came to."""

    version: ModelVersion
    new: bool
    reason: str


def manifest_of(
    selection: Selection[Any], name: str, model_list: str, config_sha256: str
) -> Manifest:
    """Describe the winner of a selection as a manifest."""
    signals = catalogue()
    winner = selection.winner.model
    label = signals[signals.label]
    return Manifest(
        name=name,
        label=ModelLabel(
            signal=signals.label, column=label.column, unit=label.unit, scale=label.scale
        ),
        intercept=winner.model.offset,
        intercept_exact=winner.model.intercept,
        terms=tuple(
            _term(signal, exact)
            for signal, exact in zip(winner.signals, winner.model.coefficients, strict=True)
        ),
        cross_validation=_cross_validated(winner, selection),
        trained_on=TrainedOn(
            cohort=selection.cohort.condition.text,
            feature_set=features().identity(selection.cohort.feature_set),
            drives=winner.drives,
            rows=winner.pooled.rows,
            logs_version=selection.cohort.logs_version,
            grams_version=selection.cohort.grams_version,
        ),
        selected_by=SelectedBy(
            model_list=model_list,
            model=winner.name,
            reason=selection.winner.reason,
            config_sha256=config_sha256,
        ),
        package_version=package_version("fleet-slip"),
    )


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


def publish(
    registry: Registry, manifest: Manifest, selection: Selection[Any], *, force: bool = False
) -> Publication:
    """Make the winner the next version and champion of its model.

    The champion's signals are cross-validated on the same cohort and folds; a challenger with a
    lower correlation is refused (`RefusedError`) unless forced. A challenger that is the same
    estimator from the same rows changes nothing. If the champion changes meanwhile, all is decided
    again.
    """

    @functools.cache
    def added() -> ModelVersion:
        return registry.add(manifest)

    def decision(newest_move: int) -> Publication | None:
        champion = registry.champion(manifest.name)
        if champion and champion.manifest.same_estimator(manifest):
            return Publication(champion, False, "The champion is this very model.")
        reason = _why_publish(champion, manifest, selection, force=force)
        published = registry.make_champion(added(), after=newest_move)
        return Publication(added(), True, reason) if published else None

    return registry.history(manifest.name).decide(decision)


def _why_publish(
    champion: ModelVersion | None, manifest: Manifest, selection: Selection[Any], *, force: bool
) -> str:
    if champion is None:
        return "It is the first version."
    challenger = selection.winner.model
    if selection.searched is not None:
        # The columns of both are given now: neither is searched for in every fold again.
        folds = selection.cohort.folds(selection.folds.by, selection.folds.count)
        challenger = validate(
            CandidateModel(name=challenger.name, signals=challenger.signals), folds
        )
    incumbent = _revalidate(champion, selection)
    comparison = (
        f"cross-validated correlation {challenger.correlation:.6f}, and "
        f"{incumbent.correlation:.6f} with the signals of {champion.reference}, on the same cohort "
        f"and folds"
    )
    if incumbent.sums.signed_r_squared > challenger.sums.signed_r_squared and not force:
        raise RefusedError(
            f"{manifest.name} was not published: it is worse than the champion ({comparison}). "
            "Use --force to publish it all the same."
        )
    return f"It has a {comparison}."


def _revalidate(champion: ModelVersion, selection: Selection[Any]) -> CrossValidation:
    folds = selection.cohort.folds(selection.folds.by, selection.folds.count)
    try:
        _require_same_features(champion)
        candidate = CandidateModel(name=champion.reference, signals=champion.manifest.signals)
        return validate(candidate, folds)
    except (DataError, QuestionError) as error:
        raise RefusedError(
            f"{champion.manifest.name} was not published: the champion {champion.reference} cannot "
            f"be compared on this cohort ({error}) Use --force to publish all the same."
        ) from None


def _require_same_features(champion: ModelVersion) -> None:
    known, known_names = features().features, features().inputs
    for name, sql in champion.manifest.features.items():
        if name not in known or known[name].sql != sql:
            raise DataError(f"its feature {name} is not defined as it was then.")
    for name, definition in champion.manifest.definitions.items():
        if name not in known_names or features().definition(name) != definition:
            raise DataError(f"its column {name} is not defined as it was then.")


def _cross_validated(winner: CrossValidation, selection: Selection[Any]) -> CrossValidated:
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
    )
