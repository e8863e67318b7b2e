"""From a selection's winner to a published model version, unless the champion is better."""

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.calibration.car_calibration import three_digits
from fleet_slip.calibration.course_label import InterceptEstimate, estimate_intercept
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import Definition
from fleet_slip.catalog.signals import MEASURED, TRAINING_DRIVES
from fleet_slip.errors import ConfigError, QuestionError, RefusedError
from fleet_slip.grams.cohort import Cohort
from fleet_slip.models.acceptance import (
    require_sound_course,
    require_sound_drives,
    review_challenger,
)
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
from fleet_slip.models.registry import CANDIDATE, CHAMPION, ModelVersion, Registry
from fleet_slip.models.request import (
    GIVEN,
    LOGGED_MODELS,
    SelectionRequest,
    checksum_of_list,
    load_model_list,
)
from fleet_slip.models.summary import Selection
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.warehouse.database import parse_cohort, with_all_drives
from fleet_slip.warehouse.gram_reader import open_grams
from fleet_slip.warehouse.warehouse import Warehouse

# How to train a model again: with the options of its champion, unless that changes nothing.

COHORT = "cohort"
"""Key of the requested predicate in stored options, if faulty drives were left out of it."""

_MODEL_OPTIONS = {"models", "model", "order", "features", "label", "ranking", "criterion"}
_MODEL_OPTIONS |= {"search", "max_features"}
"""Options that define the compared models. If one is given, no option of the champion is used."""

_STORED_NAMES = {field.name: field.name for field in fields(SelectionRequest)} | {
    "order": "nested",
    "ranking": "rank",
    "tolerance": "worth",
    "max_features": "most",
    "group_by": "by",
}
"""Names of options in manifests; some differ, as in versions of earlier releases."""


@dataclass(frozen=True)
class Recipe:
    """How to retrain a model: selection options, cohort, and an explanation for the log."""

    request: SelectionRequest
    cohort: str
    explanation: str = ""


def stored_options(selection: Selection) -> dict[str, Any] | None:
    """Return the options that a manifest stores; None if the name of its list is sufficient."""
    options = _options(selection.request)
    fell_back = not options and selection.model_list == LOGGED_MODELS
    # After a fallback to the list of logged signals, the next training tries the default list.
    if options.keys() <= {"models"} and not fell_back:
        return None
    stored = {_STORED_NAMES[name]: value for name, value in options.items()}
    is_screened = selection.requested_cohort != selection.cohort.predicate.text
    return {**stored, COHORT: selection.requested_cohort} if is_screened else stored


def recipe_for(
    registry: Registry, name: str, request: SelectionRequest, cohort: str | None = None
) -> Recipe:
    """Return the recipe of a model's champion, changed by options. Raises `QuestionError`."""
    numbers = registry.versions(name) if name in registry.names() else []
    if not numbers:
        return Recipe(request, cohort or TRAINING_DRIVES)
    version = registry.champion(name) or registry.load(name, numbers[-1])
    options = _options(request)
    if options.keys() & _MODEL_OPTIONS:
        old_cohort, verb = with_all_drives(version.manifest.trained_on.cohort), "not as"
    else:
        old_request, old_cohort = training_options(version)
        request, verb = replace(old_request, **options), "trained as"
    cohort = cohort or old_cohort
    models = version.manifest.selected_by.model_list
    instead = "" if cohort == old_cohort else f" instead of {old_cohort}"
    start = f"{verb} {version.reference}, chosen from {models}"
    return Recipe(request, cohort, f"{start}, on drives where {cohort}{instead}")


def _options(request: SelectionRequest) -> dict[str, Any]:
    """Return the options of a request that differ from the default."""
    default = SelectionRequest()
    return {name: x for name, x in vars(request).items() if x != getattr(default, name)}


def training_options(version: ModelVersion) -> tuple[SelectionRequest, str]:
    """Return the selection options and the cohort that a version was trained with.

    Raises `QuestionError` for options that no longer exist.
    """
    manifest = version.manifest
    cohort = with_all_drives(manifest.trained_on.cohort)
    stored = manifest.selected_by.options
    if stored is None:
        return _request_of_list(version), cohort
    options: dict[str, Any] = {
        name: stored[key] for name, key in _STORED_NAMES.items() if key in stored
    }
    if unknown := stored.keys() - {*_STORED_NAMES.values(), COHORT}:
        raise QuestionError(
            f"{version.reference} was selected with {', '.join(sorted(unknown))}, which select no "
            "longer has. Name a model list: --models estimator"
        )
    return SelectionRequest(**options), with_all_drives(str(stored.get(COHORT, cohort)))


def _request_of_list(version: ModelVersion) -> SelectionRequest:
    """Return the request for the model list of a version. Raises `QuestionError`."""
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
            "Name a model list: --models estimator"
        ) from None
    return SelectionRequest(models=name)


def is_current(manifest: Manifest, warehouse: Warehouse, cohort: str, models: str) -> bool:
    """Return True if a selection from a model list would give this manifest again.

    Compares table versions, cohort, list and package version. Raises `ConfigError` for the list.
    """
    model_list = load_model_list(warehouse.catalog, models)
    trained, chosen = manifest.trained_on, manifest.selected_by
    stored = (
        trained.cohort,
        trained.feature_set,
        trained.logs_version,
        trained.grams_version,
        chosen.model_list,
        chosen.config_sha256,
        manifest.package_version,
    )
    return stored == (
        cohort,
        warehouse.catalog.identity(model_list.features),
        warehouse.logs.snapshot().version or 0,  # none, where cars send Gram rows alone
        warehouse.grams.snapshot().version,
        models,
        checksum_of_list(model_list),
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
    """Return the manifest of a selection's winner, for `publish_challenger`.

    Unless forced, raises `RefusedError` for a delayed or wrong course and, except for candidates,
    for first measured drives that contradict any car.
    """
    manifest = with_straight_intercept(warehouse, manifest_of(selection, name))
    is_simulated = selection.label_noise_deg is not None  # only campaigns state it
    assumed = assumptions_of_cohort(warehouse, selection.cohort)
    if assumed and not manifest.learned_from and not is_simulated:
        assumed += ("label noise unknown: it is part of the RMSE",)
    manifest = manifest.model_copy(update={"assumed": assumed})
    if manifest.learned_from and not force:
        require_sound_course(warehouse, manifest)
    if not (force or candidate or is_simulated):
        require_sound_drives(warehouse, registry, manifest)
    return manifest


def manifest_of(selection: Selection, name: str) -> Manifest:
    """Describe the winner of a selection as a manifest."""
    catalog = selection.cohort.catalog
    signals = catalog.signals
    winner = selection.winner.model
    figures, candidates, label = winner.pooled, selection.candidate_list, signals[signals.label]
    cohort = selection.cohort
    needed = (*winner.signals, signals.label)
    drives = pack_drives(selection, name)
    definitions = catalog.definitions(cohort.feature_set)
    return Manifest(
        name=name,
        label=ModelLabel(
            signal=signals.label, column=label.column, unit=label.unit, scale=label.scale
        ),
        intercept=winner.model.offset,
        intercept_exact=winner.model.intercept,
        through_origin=not candidates.intercept,
        terms=tuple(
            _term(catalog, signal, exact, definitions)
            for signal, exact in zip(winner.signals, winner.model.coefficients, strict=True)
        ),
        cross_validation=CrossValidated(
            folds_by=candidates.folds.by,
            folds=len(winner.folds),
            correlation=figures.correlation,
            correlation_standard_error=winner.standard_error,
            rmse_deg=figures.rmse_deg,
            error_mean_deg=figures.error_mean_deg,
            error_std_deg=figures.error_std_deg,
            condition_number=winner.condition_number,
            label_noise_deg=selection.label_noise_deg,
        ),
        trained_on=TrainedOn(
            cohort=cohort.predicate.text,
            feature_set=catalog.identity(cohort.feature_set),
            drives=winner.drives,
            vehicles=cohort.count_vehicles_with(needed),
            drives_without_log=cohort.count_onboard_with(needed) or None,
            rows=selection.trained_rows,
            logs_version=cohort.logs_version,
            grams_version=cohort.grams_version,
            drives_sha256=checksum_of_drives(drives),
        ),
        selected_by=SelectedBy(
            model_list=selection.model_list,
            model=winner.name,
            reason=selection.winner.reason,
            config_sha256=selection.config_sha256,
            options=stored_options(selection),
        ),
        package_version=package_version("fleet-slip"),
        prior=_prior_of(selection),
    )


def _prior_of(selection: Selection) -> Prior | None:
    """Describe the prior of a selection; None without one."""
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
    """Return a manifest with an estimated intercept if its model was trained on changes.

    A model through the origin keeps 0. Raises `DataError` if no drive determines the intercept.
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
    return manifest.model_copy(
        update={
            "intercept": float(estimate.intercept),
            "intercept_exact": estimate.intercept,
            "learned_from": learned,
            "terms": (*manifest.terms, *terms),
        }
    )


def assumptions_of_cohort(warehouse: Warehouse, cohort: Cohort) -> tuple[str, ...]:
    """Return the assumptions of the mappings of a cohort's labelled drives."""
    from fleet_slip.ingest.mapping import ASSUMPTIONS, stored_assumptions  # noqa: PLC0415 - units

    if not (warehouse.root / ASSUMPTIONS).names():
        return ()
    with open_grams(warehouse, cohort.feature_set, cohort.predicate) as opened:
        rows = opened.label_sources(cohort.predicate)
    mappings = {name for source, name, _ in rows if source == MEASURED and name}
    return stored_assumptions(warehouse.root, mappings)


def pack_drives(selection: Selection, name: str) -> bytes:
    """Return the salted hashes of the winner's training drives, 8 bytes each."""
    signals = (*selection.winner.model.signals, selection.cohort.catalog.signals.label)
    return TrainedDrives.from_hashes(name, selection.cohort.hash_drives_with(signals)).content


def _term(
    catalog: Catalog, name: str, coefficient: Fraction, definitions: Mapping[str, Definition]
) -> ModelTerm:
    """Return a term; `definitions` are those of the feature set's columns."""
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


@dataclass(frozen=True)
class Publication(Answer):
    """Result of publishing.

    Attributes
    ----------
    version
        The new version, or the champion if nothing changed.
    new
        True if there is a new version.
    reason
        The comparison, as a sentence.
    candidate
        True if the version waits for `promote`.
    """

    DOCUMENT = (
        "model=version.manifest.name version=version.version new candidate reason "
        "sha256=version.sha256"
    )

    version: ModelVersion
    new: bool
    reason: str
    candidate: bool = False

    def parts(self) -> Iterator[Part]:
        """Return what was published, and why."""
        verb = "published" if self.new else "nothing to publish:"
        yield Remark(f"{verb} {self.version.reference}. {self.reason}")


@dataclass(frozen=True)
class DryRun(Answer):
    """Result that publishing would have.

    Attributes
    ----------
    model
        Name of the model.
    publishes
        True if there would be a new version, as champion or as candidate.
    reason
        The comparison, or why nothing would be published.
    candidate
        True if the version would wait for `promote`.
    refused
        True if `publish_challenger` would raise `RefusedError`.
    """

    model: str
    publishes: bool
    reason: str
    candidate: bool = False
    refused: bool = False

    def parts(self) -> Iterator[Part]:
        """Return what would be published, unless it is refused."""
        if not self.refused:
            verb = "would be published" if self.publishes else "would not be published"
            verb += " as a candidate" if self.publishes and self.candidate else ""
            yield Remark(f"{self.model} {verb}. {self.reason}")

    @property
    def problem(self) -> RefusedError | None:
        """The refusal that publishing would raise."""
        return RefusedError(self.reason) if self.refused else None


@dataclass(frozen=True)
class Decision:
    """Decision on a challenger.

    Attributes
    ----------
    reason
        The comparison, as a sentence.
    champion
        The champion if it stays, and nothing is published.
    waits
        True if the challenger becomes the candidate.
    """

    reason: str
    champion: ModelVersion | None = None
    waits: bool = False


def decide(
    registry: Registry,
    manifest: Manifest,
    selection: Selection,
    *,
    force: bool = False,
    candidate: bool = False,
) -> Decision:
    """Review a challenger and decide.

    A `candidate` waits for `promote`; so does any version while the champion is held by `rollback`
    or `pin`. Raises `RefusedError` if the review finds problems (`review_challenger`), unless
    forced.
    """
    name, champion = manifest.name, registry.champion(manifest.name)
    if champion and champion.manifest.same_estimator(manifest):
        return Decision("The champion is the same model.", champion)
    held = registry.history(name).held_by(CHAMPION)
    if champion and champion.manifest.has_same_terms(manifest):
        reason = "The terms are the champion's."
    else:
        review = review_challenger(registry, champion, manifest, selection)
        if not force and not candidate:
            if review.problems:
                raise RefusedError(
                    f"{name} was not published: {'; '.join(review.problems)}. Check the data. To "
                    "publish it anyway: --force"
                )
            if review.is_significantly_worse and not held:
                reason = f"The champion stays: it is significantly better. {review.reason}"
                return Decision(reason, champion)
        reason = review.reason
    waits = candidate or held is not None
    remarks = [reason, str(manifest.combination or ""), manifest.line_remark]
    if held:
        remarks.append(
            f"{name}@{held.version} stays champion: {held.command} chose it on "
            f"{held.at:%Y-%m-%d %H:%M} UTC."
        )
    if waits:
        remarks.append(f"It is a candidate until: fleet-slip promote {name}@{CANDIDATE}")
    return Decision(" ".join(filter(None, remarks)), None, waits)


def publish_challenger(
    registry: Registry, manifest: Manifest, selection: Selection, **options: bool
) -> Publication:
    """Publish a challenger as the next version of its model, and its champion; see `decide`.

    The same estimator from the same rows changes nothing. Decides again if the champion changes
    meanwhile.
    """
    history = registry.history(manifest.name)

    @functools.cache
    def add_version() -> ModelVersion:
        return registry.add(manifest, pack_drives(selection, manifest.name))

    def publish(newest_move: int) -> Publication | None:
        decision = decide(registry, manifest, selection, **options)
        if decision.champion:
            return Publication(decision.champion, False, decision.reason)
        version, alias = add_version(), CANDIDATE if decision.waits else CHAMPION
        is_set = history.pointed_at(alias) == version.version
        if not is_set and not history.move(alias, version.version, "publish", after=newest_move):
            return None  # another process moved an alias: decide again
        is_new = not (decision.waits and is_set)
        return Publication(version, is_new, decision.reason, decision.waits)

    return history.decide(publish)


def would_publish(
    registry: Registry, manifest: Manifest, selection: Selection, **options: bool
) -> DryRun:
    """Return what `publish_challenger` would do, and raise as it does; write nothing."""
    name, decision = manifest.name, decide(registry, manifest, selection, **options)
    publishes = decision.champion is None
    waiting = registry.history(name).pointed_at(CANDIDATE) if decision.waits else None
    if waiting is not None and waiting == registry.versions(name)[-1]:
        publishes = not registry.load(name, waiting).manifest.same_estimator(manifest)
    return DryRun(name, publishes, decision.reason, candidate=decision.waits)
