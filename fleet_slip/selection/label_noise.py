"""The noise of the label, below which no error that is measured against it can be.

A cross-validated mean square error is that of the model plus the variance of the label's white
noise, since a model cannot know the noise of drives that it has not seen. Only simulated drives
state it, in the `[sensors]` of their campaign.
"""

import math

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import FleetSlipError
from fleet_slip.grams.cohorts.cohort_origin import CohortOrigin
from fleet_slip.grams.cohorts.reader import open_grams
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.warehouse.tables import Warehouse


def label_noise_deg(warehouse: Warehouse, cohort: CohortOrigin) -> float | None:
    """Return the standard deviation of the label's noise, of all rows of a cohort together.

    The step of its counts is part of it, as the standard deviation of a uniform error. None where
    no campaign states it.
    """
    with open_grams(warehouse, cohort.feature_set, cohort.condition) as opened:
        rows = opened.label_sources(cohort.condition)
    stated = [(n, _stated_rad(source, campaign)) for source, campaign, n in rows]
    total = sum(n for n, _ in stated)
    if not total or any(std is None for _, std in stated):
        return None
    variance = sum(n * std**2 for n, std in stated if std is not None) / total
    step = float(catalogue()[catalogue().label].scale)
    return math.degrees(math.sqrt(variance + step**2 / 12))


def beyond_noise_deg(rmse_deg: float, noise_deg: float) -> float:
    """Return what is left of an error without the label's noise."""
    return math.sqrt(max(rmse_deg**2 - noise_deg**2, 0.0))


def _stated_rad(source: str, campaign: str | None) -> float | None:
    """Return the noise that a campaign states; None of measured drives and unknown campaigns."""
    if source != "simulated" or campaign is None:
        return None
    try:
        return load_campaign(campaign).sensors.sideslip_std_rad
    except FleetSlipError:
        return None
