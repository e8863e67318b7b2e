"""From a selection's winner to a published model version, unless the champion is better."""

import functools
from dataclasses import dataclass
from fractions import Fraction
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, QuestionError, RefusedError
from fleet_slip.models.aliases import CANDIDATE, CHAMPION, AliasMove
from fleet_slip.models.gate import compare, faults
from fleet_slip.models.manifest import (
    CrossValidated,
    Manifest,
    ModelLabel,
    ModelTerm,
    SelectedBy,
    TrainedOn,
)
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.trained_drives import checksum_of_drives, pack_drives
from fleet_slip.models.versions import Registry
from fleet_slip.regression.crossval import CrossValidation
from fleet_slip.selection.compare import Selection
from fleet_slip.selection.request import RequestedSelection


@dataclass(frozen=True)
class Publication:
    """What publishing came to."""

    version: ModelVersion
    new: bool
    reason: str
    candidate: bool = False
    """Whether it waits for somebody to promote it."""

    def as_dict(self) -> dict[str, Any]:
        """Return what `publish --json` prints."""
        return {
            "model": self.version.manifest.name,
            "version": self.version.version,
            "new": self.new,
            "candidate": self.candidate,
            "reason": self.reason,
            "sha256": self.version.sha256,
        }


def manifest_of(selection: RequestedSelection, name: str) -> Manifest:
    """Describe the winner of a selection as a manifest."""
    signals = catalogue()
    winner = selection.winner.model
    label = signals[signals.label]
    wanted = (*winner.signals, signals.label)
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
            vehicles=selection.cohort.members.count_vehicles_with(wanted),
            rows=winner.pooled.rows,
            logs_version=selection.cohort.logs_version,
            grams_version=selection.cohort.grams_version,
            drives_sha256=checksum_of_drives(drives_of(selection, name)),
        ),
        selected_by=SelectedBy(
            model_list=selection.model_list,
            model=winner.name,
            reason=selection.winner.reason,
            config_sha256=selection.config_sha256,
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
    registry: Registry,
    manifest: Manifest,
    selection: Selection[Any],
    *,
    force: bool = False,
    candidate: bool = False,
) -> Publication:
    """Make the winner the next version of its model, and its champion.

    It must be above the floor and no worse than the champion (`fleet_slip.models.gate`), else it is
    refused (`RefusedError`) unless forced. A `candidate` waits for somebody to promote it, and so
    does whatever is published while the champion is held by `rollback` or `pin`. A challenger that
    is the same estimator from the same rows changes nothing. If the champion changes meanwhile, all
    is decided again.
    """
    history = registry.history(manifest.name)

    @functools.cache
    def added() -> ModelVersion:
        return registry.add(manifest, drives_of(selection, manifest.name))

    def decision(newest_move: int) -> Publication | None:
        champion = registry.champion(manifest.name)
        if champion and champion.manifest.same_estimator(manifest):
            return Publication(champion, False, "The champion is this very model.")
        held = history.held_by(CHAMPION)
        if candidate:
            reason = _describe(champion, manifest, selection)
        else:
            reason = _why_publish(champion, manifest, selection, force=force)
        if candidate or held:
            return _wait(registry, added(), newest_move, reason, held)
        published = registry.make_champion(added(), after=newest_move)
        return Publication(added(), True, reason) if published else None

    return history.decide(decision)


def _wait(
    registry: Registry, version: ModelVersion, newest: int, reason: str, held: AliasMove | None
) -> Publication | None:
    """Make a version the candidate; return None if an alias moved after the move given."""
    name = version.manifest.name
    history = registry.history(name)
    there = history.pointed_at(CANDIDATE) == version.version
    if not there and not history.move(CANDIDATE, version.version, "publish", after=newest):
        return None
    why = (
        f"{name}@{held.version} stays champion since it was {_DONE[held.command]} on "
        f"{held.at:%Y-%m-%d %H:%M} UTC"
        if held
        else "It is a candidate"
    )
    reason = f"{reason} {why}, until: fleet-slip promote {version.reference}"
    return Publication(version, not there, reason, candidate=True)


_DONE = {"rollback": "rolled back to", "pin": "pinned"}


def drives_of(selection: Selection[Any], name: str) -> bytes:
    """Return the content of the file about the drives that a selection's winner was trained on."""
    signals = (*selection.winner.model.signals, catalogue().label)
    return pack_drives(name, selection.cohort.members.drives_with(signals))


def _why_publish(
    champion: ModelVersion | None, manifest: Manifest, selection: Selection[Any], *, force: bool
) -> str:
    problems = faults(manifest, champion.manifest if champion else None)
    compared = "It is the first version"
    if champion is not None:
        try:
            comparison = compare(selection, champion)
        except (DataError, QuestionError) as error:
            problems.append(f"the champion {champion.reference} cannot be compared ({error})")
        else:
            compared = str(comparison)
            if not comparison.shortfall.negligible:
                problems.append(f"it is worse than the champion: {comparison}")
    if problems and not force:
        raise RefusedError(
            f"{manifest.name} was not published: {'; '.join(problems)}. Look at the data, or use "
            "--force to publish it all the same."
        )
    return f"{_capitalised('; '.join(problems) or compared)}."


def _describe(champion: ModelVersion | None, manifest: Manifest, selection: Selection[Any]) -> str:
    """Return what the gate says of a candidate, which passes it all the same."""
    return _why_publish(champion, manifest, selection, force=True)


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]


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
