"""Simulated drives as a prior: their Gram rows join those of real ones, with a weight.

They depend only on the file of a campaign. Each use simulates them in a temporary data root, so
that no cohort contains them.
"""

import os
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.simulate import simulate_campaign
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse

NOT_LOST = "lost_control_s IS NULL"
"""Predicate of the drives in which the driver kept control."""


def simulate_prior(
    catalog: Catalog,
    campaign: str | Campaign,
    feature_set: str,
    executor: Executor | None = None,
) -> Cohort:
    """Return the Gram rows of the drives of a campaign in which the driver kept control.

    Raises `ConfigError` for an invalid file, `DataError` if control was lost in every drive.
    """
    if isinstance(campaign, str):
        campaign = load_campaign(campaign, catalog.configs)
    workers = nullcontext(executor) if executor else ThreadPoolExecutor(os.cpu_count())
    with TemporaryDirectory(prefix="fleet-slip-prior-") as folder, workers as threads:
        warehouse = Warehouse(LocalFolder(Path(folder)), catalog.configs)
        if model := catalog.first_stage_model(feature_set):
            warehouse.stacked_models.keep(model)
        simulate_campaign(warehouse, campaign, campaign.days(), threads)
        update_grams(warehouse, feature_set=feature_set)
        try:
            return replace(load_cohort(warehouse, NOT_LOST, feature_set), source=None)
        except DataError as error:
            raise DataError(
                f"prior {campaign.name}: the driver lost control in all drives. Check the vehicle "
                "file: fleet-slip identify lists the parameters it could not identify."
            ) from error
