"""From a selection's winner to a published model version, unless the champion is better."""

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, QuestionError, RefusedError, StorageError
from fleet_slip.grams.cohorts.taught_cohort import TaughtCohort
from fleet_slip.models.acceptance.gate import compare, faults
from fleet_slip.models.acceptance.vouched import ODD, odd_gain
from fleet_slip.models.aliases import CANDIDATE, CHAMPION, AliasMove
from fleet_slip.models.manifest import (
    CrossValidated,
    LearnedFrom,
    Manifest,
    ModelLabel,
    ModelTerm,
    SelectedBy,
    TrainedOn,
)
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.recipe import asked_of
from fleet_slip.models.straight_on import StraightOn, straight_on
from fleet_slip.models.trained_drives import DriveRecord
from fleet_slip.models.versions import Registry
from fleet_slip.regression.validation.crossval import CrossValidation
from fleet_slip.selection.select_models import RequestedSelection, Selection
from fleet_slip.warehouse.condition import parse_cohort
from fleet_slip.warehouse.tables import Warehouse


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
            drives_sha256=drives.listed_sha256,
            files_sha256=drives.files_sha256,
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

    It must be above the floor, and no worse than the champion and the best of the champions so far
    (`acceptance.gate`), else it is refused (`RefusedError`) unless forced. A `candidate` waits for
    somebody to promote it, and so does whatever is published while the champion is held by
    `rollback` or `pin`. A challenger that is the same estimator from the same rows changes nothing.
    If the champion changes meanwhile, all is decided again.
    """
    history = registry.history(manifest.name)

    @functools.cache
    def added() -> ModelVersion:
        return registry.add(manifest, drives_of(selection, manifest.name))

    def publication(newest_move: int) -> Publication | None:
        found = _decide(registry, manifest, selection, force=force, candidate=candidate)
        if found.stays:
            return Publication(found.stays, False, found.reason)
        if found.waits:
            return _wait(registry, added(), newest_move, found)
        version = added()
        published = registry.make_champion(version, after=newest_move, best=found.best)
        return Publication(version, True, found.reason) if published else None

    return history.decide(publication)


@dataclass(frozen=True)
class DryRun:
    """What publishing would come to.

    Attributes:
        model: its name.
        publishes: whether there would be a new version, as champion or as candidate.
        reason: what was compared, else why nothing would be published.
        candidate: whether it would wait for somebody to promote it.
        refused: whether `publish` would raise `RefusedError`.
    """

    model: str
    publishes: bool
    reason: str
    candidate: bool = False
    refused: bool = False


def would_publish(
    registry: Registry,
    manifest: Manifest,
    selection: Selection[Any],
    *,
    force: bool = False,
    candidate: bool = False,
) -> DryRun:
    """Tell what `publish` of the same would come to; nothing is written. Raises as it does."""
    found = _decide(registry, manifest, selection, force=force, candidate=candidate)
    if found.stays:
        return DryRun(manifest.name, False, found.reason)
    registry.require_key()
    if not found.waits:
        return DryRun(manifest.name, True, found.reason)
    waiting = registry.history(manifest.name).pointed_at(CANDIDATE)
    newest = max(registry.versions(manifest.name), default=None)
    there = (
        waiting is not None
        and waiting == newest
        and (registry.load(manifest.name, waiting).manifest.same_estimator(manifest))
    )
    reason = f"{found.reason} {_why(manifest.name, found.held)}."
    return DryRun(manifest.name, not there, reason, candidate=True)


@dataclass(frozen=True)
class _Decision:
    """What is to become of a challenger.

    Attributes:
        reason: what was compared, as a sentence.
        stays: the champion, if nothing is published.
        waits: whether it becomes the candidate.
        held: the move that holds the champion.
        best: the number of the best champion so far, as `Registry.make_champion` takes it.
    """

    reason: str
    stays: ModelVersion | None = None
    waits: bool = False
    held: AliasMove | None = None
    best: int | None = None


def _decide(
    registry: Registry,
    manifest: Manifest,
    selection: Selection[Any],
    *,
    force: bool,
    candidate: bool,
) -> _Decision:
    """Decide what becomes of a challenger. Raises `RefusedError`."""
    champion = registry.champion(manifest.name)
    if champion and champion.manifest.same_estimator(manifest):
        return _Decision("The champion is this very model.", champion)
    held = registry.history(manifest.name).held_by(CHAMPION)
    judgement = _judge(registry, champion, manifest, selection)
    if not force and not candidate:
        judgement.require_passed(manifest.name)
    if champion and judgement.drifts and not (force or candidate or held):
        reason = f"The champion stays, since it is better for sure. {judgement.reason}"
        return _Decision(reason, champion)
    best = None if judgement.problems else judgement.best
    return _Decision(judgement.reason, None, candidate or held is not None, held, best)


def _wait(
    registry: Registry, version: ModelVersion, newest: int, found: _Decision
) -> Publication | None:
    """Make a version the candidate; return None if an alias moved after the move given."""
    name = version.manifest.name
    history = registry.history(name)
    there = history.pointed_at(CANDIDATE) == version.version
    if not there and not history.move(CANDIDATE, version.version, "publish", after=newest):
        return None
    until = f"until: fleet-slip promote {version.reference}"
    reason = f"{found.reason} {_why(name, found.held)}, {until}"
    return Publication(version, not there, reason, candidate=True)


def _why(name: str, held: AliasMove | None) -> str:
    """Say why a version waits."""
    if held is None:
        return "It is a candidate"
    done = f"{_DONE[held.command]} on {held.at:%Y-%m-%d %H:%M} UTC"
    return f"{name}@{held.version} stays champion since it was {done}"


_DONE = {"rollback": "rolled back to", "pin": "pinned"}


def drives_of(selection: Selection[Any], name: str) -> DriveRecord:
    """Return what tells the drives that a selection's winner was trained on."""
    signals = (*selection.winner.model.signals, catalogue().label)
    return DriveRecord.of(name, *selection.cohort.members.by_file(signals))


@dataclass(frozen=True)
class _Judgement:
    """What the gate says of a challenger.

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
                f"{name} was not published: {'; '.join(self.problems)}. Look at the data, or "
                "publish it with force all the same."
            )


def _judge(
    registry: Registry,
    champion: ModelVersion | None,
    manifest: Manifest,
    selection: Selection[Any],
) -> _Judgement:
    problems = faults(manifest, champion.manifest if champion else None)
    if champion is None:
        return _Judgement(tuple(problems), "It is the first version")
    try:
        incumbents = _incumbents(registry, champion)
        comparison = compare(selection, incumbents)
    except (DataError, QuestionError) as error:
        problems.append(f"the champion {champion.reference} cannot be compared ({error})")
        return _Judgement(tuple(problems), "")
    if comparison.contradicted:
        problems.append(
            f"the label runs against what {champion.reference} estimates: is it reversed? "
            f"{comparison}"
        )
    better = [one.name for one in comparison.better]
    if champion.reference in better:
        problems.append(f"it is worse than the champion: {comparison}")
    elif better:
        problems.append(
            f"it is worse than {better[0]}, the best of the champions so far, from which small "
            f"steps have led away: {comparison}. To begin anew at the champion: fleet-slip promote "
            f"{champion.reference}"
        )
    then = champion.manifest
    if then.learned_from is None and manifest.learned_from is None:
        was, now = then.cross_validation.rmse_deg, comparison.incumbents[0].pooled.rmse_deg
        if now > ODD * was and not problems:
            problems.append(
                f"{champion.reference} had an RMSE of {was:.4f} deg on drives that did not train "
                f"it, and has {now:.4f} deg on these: most of it comes from drives unlike those "
                f"that vouch for it. Look at them before they teach: {comparison}"
            )
    try:
        if not problems and (odd := odd_gain(registry, selection, champion)):
            problems.append(odd)
    except StorageError as error:
        problems.append(f"it cannot be judged on the drives that made the champion: {error}")
    best = next((one.version for one in incumbents if one.reference == comparison.best), None)
    return _Judgement(tuple(problems), str(comparison), best, comparison.drifts)


def _incumbents(registry: Registry, champion: ModelVersion) -> list[ModelVersion]:
    """Return the champion, and the best of the champions so far if that is another version."""
    name = champion.manifest.name
    best = registry.history(name).best_of(CHAMPION)
    others = [] if best in (None, champion.version) else [registry.load(name, best)]
    return [champion, *others]


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
