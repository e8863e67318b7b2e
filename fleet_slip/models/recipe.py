"""How a model is trained again: as its champion was, and whether that would change anything."""

from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version as package_version
from typing import Any

from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import ConfigError, QuestionError
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.runs.nights import with_all_drives
from fleet_slip.selection.answer_request import GIVEN, checksum_of_list
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.selection.select_models import RequestedSelection
from fleet_slip.warehouse.tables import Warehouse

COHORT = "cohort"
"""Key of the condition that was asked, where cars were left out of it."""

_WHAT = {"models", "model", "nested", "features", "label", "rank", "criterion", "all_subsets"}
_WHAT |= {"search", "most"}
"""What says which models are compared: who asks for one of these asks for all anew."""


@dataclass(frozen=True)
class Recipe:
    """What is asked for, of which drives, and in words whose it is and what is new in it."""

    request: SelectionRequest
    cohort: str
    told: str = ""


def asked_of(selection: RequestedSelection) -> dict[str, Any] | None:
    """Return what a manifest keeps of what was asked for; None if its list says it all."""
    asked = _asked(selection.request)
    if asked.keys() <= {"models"}:
        return None
    whole = selection.asked == selection.cohort.condition.text
    return asked if whole else {**asked, COHORT: selection.asked}


def recipe_for(
    registry: Registry, name: str, request: SelectionRequest, cohort: str | None = None
) -> Recipe:
    """Return how to train a model as before, but for what is asked. Raises `QuestionError`."""
    before = _newest(registry, name)
    asked = _asked(request)
    if before is None:
        return Recipe(request, cohort or TRAINING_DRIVES)
    chosen_from = before.manifest.selected_by.model_list
    was = with_all_drives(before.manifest.trained_on.cohort)
    if asked.keys() & _WHAT:
        wanted = request
        told = f"not as {before.reference}, chosen from {chosen_from}"
    else:
        kept, was = _kept(before)
        wanted = replace(kept, **asked)
        told = f"trained as {before.reference}, chosen from {chosen_from}"
    if cohort is None or cohort == was:
        return Recipe(wanted, was, f"{told}, on drives where {was}")
    return Recipe(wanted, cohort, f"{told}, but not on drives where {was}: this is where {cohort}")


def _asked(request: SelectionRequest) -> dict[str, Any]:
    usual = asdict(SelectionRequest())
    return {name: value for name, value in asdict(request).items() if value != usual[name]}


def _newest(registry: Registry, name: str) -> ModelVersion | None:
    if name not in registry.names():
        return None
    numbers = registry.versions(name)
    return registry.champion(name) or (registry.load(name, numbers[-1]) if numbers else None)


def _kept(version: ModelVersion) -> tuple[SelectionRequest, str]:
    manifest = version.manifest
    chosen = manifest.selected_by
    cohort = with_all_drives(manifest.trained_on.cohort)
    if chosen.asked is None:
        return _of_list(manifest, version.reference), cohort
    known = {field.name for field in fields(SelectionRequest)}
    asked: dict[str, Any] = {name: one for name, one in chosen.asked.items() if name in known}
    return SelectionRequest(**asked), with_all_drives(str(chosen.asked.get(COHORT, cohort)))


def _of_list(manifest: Manifest, reference: str) -> SelectionRequest:
    name = manifest.selected_by.model_list
    if name == GIVEN:
        feature_set = features().name_of(manifest.trained_on.feature_set)
        return SelectionRequest(model=",".join(manifest.signals), features=feature_set)
    try:
        load_model_list(name)
    except ConfigError:
        raise QuestionError(
            f"{reference} was chosen from {name!r}, which is no model list here. Say what to "
            "compare, such as models = estimator."
        ) from None
    return SelectionRequest(models=name)


def is_up_to_date(
    manifest: Manifest, warehouse: Warehouse, cohort: str, models: str, worth: str | None
) -> bool:
    """Return whether a selection from a model list would come to this manifest again.

    It is a function of table versions, cohort, list and program. Raises `ConfigError` for the list.
    """
    model_list = load_model_list(models)
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
        features().identity(model_list.features),
        warehouse.logs.snapshot().version or 0,  # none, where cars send Gram rows alone
        warehouse.grams.snapshot().version,
        models,
        checksum_of_list(model_list, worth),
        package_version("fleet-slip"),
    )
