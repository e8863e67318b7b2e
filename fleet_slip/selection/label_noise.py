"""The noise of the label, below which no error that is measured against it can be.

A cross-validated mean square error is that of the model plus the variance of the label's white
noise, since a model cannot know the noise of drives that it has not seen. Only simulated drives
state it, in the `[sensors]` of their campaign.
"""

import math

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.grams.cohorts.cohort_origin import CohortOrigin
from fleet_slip.grams.cohorts.gram_reader import open_grams
from fleet_slip.resources import find_config
from fleet_slip.warehouse.tables import Warehouse


def label_noise_deg(warehouse: Warehouse, cohort: CohortOrigin) -> float | None:
    """Return the standard deviation of the label's noise, of all rows of a cohort together.

    The step of its counts is part of it, as the standard deviation of a uniform error. None where
    no campaign states it.
    """
    if not warehouse.logs.snapshot().rows:  # all rows are of messages: none is read for this
        return None
    with open_grams(warehouse, cohort.feature_set, cohort.condition) as opened:
        rows = opened.label_sources(cohort.condition)
    stated = [(n, _stated_rad(source, campaign)) for source, campaign, n in rows]
    total = sum(n for n, _ in stated)
    if not total or any(std is None for _, std in stated):
        return None
    variance = sum(n * std**2 for n, std in stated if std is not None) / total
    step = float(catalogue()[catalogue().label].scale)
    return math.degrees(math.sqrt(variance + step**2 / 12))


def _stated_rad(source: str, campaign: str | None) -> float | None:
    """Return the noise that a campaign states; None of measured drives and unknown campaigns."""
    if source != "simulated" or campaign is None:
        return None
    try:
        content = load_toml(find_config("campaigns", campaign))
        if "sensors" not in content:
            content = load_toml(find_config("campaigns", content["base"]))
        return float(content["sensors"]["sideslip_std_rad"])
    except (ConfigError, KeyError):  # its file was elsewhere
        return None
