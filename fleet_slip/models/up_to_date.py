"""Whether a published version is what a selection would publish again."""

from importlib.metadata import version as package_version

from fleet_slip.catalogue.features import features
from fleet_slip.models.manifest import Manifest
from fleet_slip.selection.answer_request import checksum_of_list
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.warehouse.tables import Warehouse


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
