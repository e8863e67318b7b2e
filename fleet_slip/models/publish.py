"""From a selection's winner to a published model version, unless the champion is better."""

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from fractions import Fraction
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.calibration.car_calibration import three_digits
from fleet_slip.calibration.intercept import InterceptEstimate, estimate_intercept
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import Definition
from fleet_slip.catalog.drive_sources import MEASURED, TRAINING_DRIVES
from fleet_slip.errors import ConfigError, QuestionError, RefusedError
from fleet_slip.models.acceptance import review_challenger
from fleet_slip.models.manifest import (
    CrossValidated,
    LearnedFrom,
    Manifest,
    ModelLabel,
    ModelTerm,
    Prior,
    SelectedBy,
    TrainedDrives,
    TrainedOn,
    checksum_of_drives,
)
from fleet_slip.models.registry import CANDIDATE, CHAMPION, AliasMove, ModelVersion, Registry
from fleet_slip.models.request import (
    GIVEN,
    LOGGED_MODELS,
    SelectionRequest,
    checksum_of_list,
    load_model_list,
)
from fleet_slip.models.select import Selection
from fleet_slip.models.training_checks import (
    require_in_time,
    require_sound_course,
    require_sound_drives,
)
from fleet_slip.regression.folds import CrossValidation
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.warehouse.gram_reader import open_grams
from fleet_slip.warehouse.predicate import parse_cohort, with_all_drives
from fleet_slip.warehouse.warehouse import Warehouse

# How a model is trained again: as its champion was, and whether that would change anything.

COHORT = "cohort"
"""Key of the predicate that was asked, where cars were left out of it."""

_MODEL_OPTIONS = {"models", "model", "order", "features", "label", "ranking", "criterion"}
_MODEL_OPTIONS |= {"all_subsets", "search", "max_features"}
"""Options that define which models are compared: with one of these, none is taken from before."""

_STORED_NAMES = {
    "order": "nested",
    "ranking": "rank",
    "tolerance": "worth",
    "max_features": "most",
    "group_by": "by",
}
"""Names of options in manifests, where they differ: versions of earlier releases have them."""


@dataclass(frozen=True)
class Recipe:
    """How to retrain a model: selection options, cohort, and an explanation for the log."""

    request: SelectionRequest
    cohort: str
    explanation: str = ""


def stored_options(selection: Selection) -> dict[str, Any] | None:
    """Return the options that a manifest stores; None if the name of its list is enough."""
    options = _options(selection.request)
    fell_back = not options and selection.model_list == LOGGED_MODELS
    if options.keys() <= {"models"} and not fell_back:  # else the default list next time
        return None
    stored = {_STORED_NAMES.get(name, name): value for name, value in options.items()}
    is_screened = selection.asked_condition != selection.cohort.predicate.text
    return {**stored, COHORT: selection.asked_condition} if is_screened else stored


def recipe_for(
    registry: Registry, name: str, request: SelectionRequest, cohort: str | None = None
) -> Recipe:
    """Return how to train a model as before, but for given options. Raises `QuestionError`."""
    version = _newest(registry, name)
    options = _options(request)
    if version is None:
        return Recipe(request, cohort or TRAINING_DRIVES)
    model_list = version.manifest.selected_by.model_list
    if options.keys() & _MODEL_OPTIONS:
        old_cohort = with_all_drives(version.manifest.trained_on.cohort)
        explanation = f"not as {version.reference}, chosen from {model_list}"
    else:
        old_request, old_cohort = recipe_of(version)
        request = replace(old_request, **options)
        explanation = f"trained as {version.reference}, chosen from {model_list}"
    if cohort is None or cohort == old_cohort:
        return Recipe(request, old_cohort, f"{explanation}, on drives where {old_cohort}")
    explanation += f", but on drives where {cohort} instead of {old_cohort}"
    return Recipe(request, cohort, explanation)


def _options(request: SelectionRequest) -> dict[str, Any]:
    """Return the options of a request that differ from the default."""
    default = asdict(SelectionRequest())
    return {name: value for name, value in asdict(request).items() if value != default[name]}


def _newest(registry: Registry, name: str) -> ModelVersion | None:
    """Return the champion of a model, else its newest version, else None."""
    if name not in registry.names():
        return None
    numbers = registry.versions(name)
    return registry.champion(name) or (registry.load(name, numbers[-1]) if numbers else None)


def recipe_of(version: ModelVersion) -> tuple[SelectionRequest, str]:
    """Return what a version was chosen by, and on which drives. Raises `QuestionError`."""
    manifest = version.manifest
    chosen = manifest.selected_by
    cohort = with_all_drives(manifest.trained_on.cohort)
    if chosen.asked is None:
        return _of_list(version), cohort
    options: dict[str, Any] = {
        field.name: chosen.asked[stored]
        for field in fields(SelectionRequest)
        if (stored := _STORED_NAMES.get(field.name, field.name)) in chosen.asked
    }
    return SelectionRequest(**options), with_all_drives(str(chosen.asked.get(COHORT, cohort)))


def _of_list(version: ModelVersion) -> SelectionRequest:
    manifest = version.manifest
    name = manifest.selected_by.model_list
    if name == GIVEN:
        feature_set = version.catalog.name_of(manifest.trained_on.feature_set)
        return SelectionRequest(model=",".join(manifest.signals), features=feature_set)
    try:
        load_model_list(version.catalog, name)
    except ConfigError:
        raise QuestionError(
            f"{version.reference} was chosen from {name!r}, which is no model list here. "
            "Say what to compare, such as models = estimator."
        ) from None
    return SelectionRequest(models=name)


def is_current(
    manifest: Manifest, warehouse: Warehouse, cohort: str, models: str, tolerance: str | None
) -> bool:
    """Return whether a selection from a model list would come to this manifest again.

    It is a function of table versions, cohort, list and program. Raises `ConfigError` for the list.
    """
    model_list = load_model_list(warehouse.catalog, models)
    trained, chosen = manifest.trained_on, manifest.selected_by
    made_from = (
        trained.cohort,
        trained.feature_set,
        trained.logs_version,
        trained.grams_version,
        chosen.model_list,
        chosen.config_sha256,
        manifest.package_version,
    )
    return manifest.imported_from is None and made_from == (
        cohort,
        warehouse.catalog.identity(model_list.features),
        warehouse.logs.snapshot().version or 0,  # none, where cars send Gram rows alone
        warehouse.grams.snapshot().version,
        models,
        checksum_of_list(model_list, tolerance),
        package_version("fleet-slip"),
    )


def build_challenger(
    warehouse: Warehouse,
    registry: Registry,
    selection: Selection,
    name: str,
    *,
    force: bool,
    candidate: bool,
) -> Manifest:
    """Return the winner of a selection as the manifest that `publish_challenger` takes.

    Unless forced, raises `RefusedError` for a late or false course and, unless it is to be a
    candidate, for first measured drives that contradict any car.
    """
    manifest = with_straight_intercept(warehouse, manifest_of(selection, name))
    manifest = with_assumptions(warehouse, manifest, selection)
    if manifest.learned_from and not force:
        delays_s = require_in_time(warehouse, manifest)
        require_sound_course(warehouse, manifest, delays_s)
    simulated = selection.label_noise_deg is not None  # nobody states the noise of others
    if not (force or candidate or simulated):
        champion = registry.champion(name)
        made = registry.trained_drives(champion.manifest) if champion else None
        settled = len(champion.manifest.terms) if champion else 0
        require_sound_drives(warehouse, manifest, made, settled)
    return manifest


def manifest_of(selection: Selection, name: str) -> Manifest:
    """Describe the winner of a selection as a manifest."""
    catalog = selection.cohort.catalog
    signals = catalog.signals
    winner = selection.winner.model
    label = signals[signals.label]
    wanted = (*winner.signals, signals.label)
    drives = drives_of(selection, name)
    definitions = catalog.definitions(selection.cohort.feature_set)
    return Manifest(
        name=name,
        label=ModelLabel(
            signal=signals.label, column=label.column, unit=label.unit, scale=label.scale
        ),
        intercept=winner.model.offset,
        intercept_exact=winner.model.intercept,
        through_origin=not selection.intercept,
        terms=tuple(
            _term(catalog, signal, exact, definitions)
            for signal, exact in zip(winner.signals, winner.model.coefficients, strict=True)
        ),
        cross_validation=_cross_validated(winner, selection),
        trained_on=TrainedOn(
            cohort=selection.cohort.predicate.text,
            feature_set=catalog.identity(selection.cohort.feature_set),
            drives=winner.drives,
            vehicles=selection.cohort.count_vehicles_with(wanted),
            drives_without_log=selection.cohort.count_onboard_with(wanted) or None,
            rows=selection.trained_rows,
            logs_version=selection.cohort.logs_version,
            grams_version=selection.cohort.grams_version,
            drives_sha256=checksum_of_drives(drives),
        ),
        selected_by=SelectedBy(
            model_list=selection.model_list,
            model=winner.name,
            reason=selection.winner.reason,
            config_sha256=selection.config_sha256,
            asked=stored_options(selection),
        ),
        package_version=package_version("fleet-slip"),
        prior=_prior_of(selection),
    )


def _prior_of(selection: Selection) -> Prior | None:
    prior, name = selection.cohort.prior, selection.request.prior
    if prior is None or name is None:
        return None
    from fleet_slip.simulation.campaign import load_campaign  # noqa: PLC0415 - simulates

    campaign = load_campaign(name, selection.cohort.catalog.configs)
    return Prior(
        campaign=campaign.name,
        campaign_sha256=campaign.digest,
        vehicles=tuple(sorted(set(prior.drives["vehicle_model"].to_pylist()))),
        drives=prior.drive_count,
        rows=prior.rows,
        weight=selection.cohort.weight,
    )


def with_straight_intercept(warehouse: Warehouse, manifest: Manifest) -> Manifest:
    """Return a manifest with the intercept that changes do not tell, if changes taught its model.

    One through the origin keeps 0, of no cars. Raises `DataError` if no drive tells the intercept.
    """
    catalog = warehouse.catalog
    name = catalog.name_of(manifest.trained_on.feature_set)
    change_s = catalog.feature_set(name).change_s
    if not change_s:
        return manifest
    estimate = InterceptEstimate()
    if not manifest.through_origin:
        predicate = parse_cohort(catalog.signals, manifest.trained_on.cohort)
        coefficients = {
            term.signal: term.coefficient_exact * Fraction(term.scale_exact)
            for term in manifest.terms
        }
        estimate = estimate_intercept(warehouse, predicate, name, coefficients)
    learned = LearnedFrom(
        label="course",
        change_s=float(change_s[0]) if len(change_s) == 1 else tuple(map(float, change_s)),
        cars=estimate.cars,
        intercept_uncertainty_deg=(
            None
            if estimate.uncertainty is None
            else three_digits(math.degrees(estimate.uncertainty))
        ),
        intercept_spread_deg=math.degrees(estimate.std_between_cars),
    )
    scales = catalog.input_scales
    terms = (
        _term(catalog, column, slope / scales[column], {})
        for column, slope in estimate.slopes.items()
    )
    own = {"intercept": float(estimate.intercept), "intercept_exact": estimate.intercept}
    origin = {"learned_from": learned, "terms": (*manifest.terms, *terms)}
    return manifest.model_copy(update={**own, **origin})


def with_assumptions(warehouse: Warehouse, manifest: Manifest, selection: Selection) -> Manifest:
    """Return a manifest with what the mappings of its drives leave open."""
    from fleet_slip.ingest.mapping import ASSUMPTIONS, kept_assumptions  # noqa: PLC0415 - units

    if not (warehouse.root / ASSUMPTIONS).names():
        return manifest
    cohort = selection.cohort
    with open_grams(warehouse, cohort.feature_set, cohort.predicate) as opened:
        rows = opened.label_sources(cohort.predicate)
    mappings = {name for source, name, _ in rows if source == MEASURED and name}
    assumed = kept_assumptions(warehouse.root, mappings)
    if assumed and not manifest.learned_from and selection.label_noise_deg is None:
        assumed += ("label noise unknown: it is part of the RMSE",)
    return manifest.model_copy(update={"assumed": assumed})


def drives_of(selection: Selection, name: str) -> bytes:
    """Return the salted hashes of the drives that a selection's winner was trained on, packed."""
    signals = (*selection.winner.model.signals, selection.cohort.catalog.signals.label)
    return TrainedDrives.of(name, selection.cohort.hash_drives_with(signals)).content


def _term(
    catalog: Catalog, name: str, coefficient: Fraction, definitions: Mapping[str, Definition]
) -> ModelTerm:
    """Return a term; `definitions` are those of the set's columns, which a line may have made."""
    column, features = catalog.input(name), catalog.features
    definition = definitions.get(name) or catalog.definition(name)
    return ModelTerm(
        signal=name,
        column=column.column,
        unit=column.unit,
        scale=column.scale,
        sql=features[name].sql if name in features and not definition else "",
        definition=definition,
        signal_scales=(
            {signal: catalog.signals[signal].scale for signal in definition.signals}
            if definition
            else None
        ),
        coefficient=float(coefficient),
        coefficient_exact=coefficient,
    )


def _cross_validated(winner: CrossValidation, selection: Selection) -> CrossValidated:
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


@dataclass(frozen=True)
class Publication(Answer):
    """What publishing came to."""

    DOCUMENT = (
        "model=version.manifest.name version=version.version new candidate reason "
        "sha256=version.sha256"
    )

    version: ModelVersion
    new: bool
    reason: str
    candidate: bool = False
    """Whether it waits for somebody to promote it."""

    def parts(self) -> Iterator[Part]:
        """Return what was published, and why."""
        done = "published" if self.new else "nothing to publish:"
        yield Remark(f"{done} {self.version.reference}. {self.reason}")


def publish_challenger(
    registry: Registry,
    manifest: Manifest,
    selection: Selection,
    *,
    force: bool = False,
    candidate: bool = False,
) -> Publication:
    """Make the winner the next version of its model, and its champion.

    It must be above the floor, and no worse than the champion and the best of the champions so far
    (`champion_rules`), else it is refused (`RefusedError`) unless forced. A `candidate` waits for
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
        version = added()
        alias, best = (CANDIDATE, None) if found.waits else (CHAMPION, found.best)
        number = version.version
        there = history.pointed_at(alias) == number
        moved = there or history.move(alias, number, "publish", after=newest_move, best=best)
        if not moved:
            return None
        if not found.waits:
            return Publication(version, True, found.reason)
        until = f"until: fleet-slip promote {version.reference}"
        reason = f"{found.reason} {_why(manifest.name, found.held)}, {until}"
        return Publication(version, not there, reason, candidate=True)

    return history.decide(publication)


@dataclass(frozen=True)
class DryRun(Answer):
    """What publishing would come to.

    Attributes:
        model: its name.
        publishes: whether there would be a new version, as champion or as candidate.
        reason: what was compared, else why nothing would be published.
        candidate: whether it would wait for somebody to promote it.
        refused: whether `publish_challenger` would raise `RefusedError`.
    """

    model: str
    publishes: bool
    reason: str
    candidate: bool = False
    refused: bool = False

    def parts(self) -> Iterator[Part]:
        """Return what would be published, unless it is refused."""
        if not self.refused:
            would = "would be published" if self.publishes else "would not be published"
            would += " as a candidate" if self.publishes and self.candidate else ""
            yield Remark(f"{self.model} {would}. {self.reason}")

    @property
    def problem(self) -> RefusedError | None:
        """That it would be refused."""
        return RefusedError(self.reason) if self.refused else None


def would_publish(
    registry: Registry,
    manifest: Manifest,
    selection: Selection,
    *,
    force: bool = False,
    candidate: bool = False,
) -> DryRun:
    """Tell what `publish_challenger` would come to, and raise as it does; nothing is written."""
    found = _decide(registry, manifest, selection, force=force, candidate=candidate)
    if found.stays:
        return DryRun(manifest.name, False, found.reason)
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
        best: the number of the best champion so far, as `AliasHistory.move` takes it.
    """

    reason: str
    stays: ModelVersion | None = None
    waits: bool = False
    held: AliasMove | None = None
    best: int | None = None


def _decide(
    registry: Registry,
    manifest: Manifest,
    selection: Selection,
    *,
    force: bool,
    candidate: bool,
) -> _Decision:
    """Decide what becomes of a challenger. Raises `RefusedError`."""
    champion = registry.champion(manifest.name)
    if champion and champion.manifest.same_estimator(manifest):
        return _Decision("The champion is the same model.", champion)
    held = registry.history(manifest.name).held_by(CHAMPION)
    review = review_challenger(registry, champion, manifest, selection)
    if not force and not candidate:
        review.require_passed(manifest.name)
    if champion and review.is_significantly_worse and not (force or candidate or held):
        reason = f"The champion stays: it is significantly better. {review.reason}"
        return _Decision(reason, champion)
    best = None if review.problems else review.best
    return _Decision(review.reason, None, candidate or held is not None, held, best)


def _why(name: str, held: AliasMove | None) -> str:
    """Say why a version waits."""
    if held is None:
        return "It is a candidate"
    done = f"{_DONE[held.command]} on {held.at:%Y-%m-%d %H:%M} UTC"
    return f"{name}@{held.version} stays champion: it was {done}"


_DONE = {"rollback": "rolled back to", "pin": "pinned"}
