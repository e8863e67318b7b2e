"""The noise of the label of a cohort, as campaigns state it."""

import math

from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.grams.cohort import Cohort
from fleet_slip.resources import Configs
from fleet_slip.warehouse.gram_reader import open_grams
from fleet_slip.warehouse.warehouse import Warehouse


def label_noise_deg(warehouse: Warehouse, cohort: Cohort) -> float | None:
    """Return the standard deviation of the label's noise, of all rows of a cohort together.

    It is part of every cross-validated error. The quantisation step counts as a uniform error.
    None where no campaign states it in its `[sensors]`.
    """
    if not warehouse.logs.snapshot().rows:  # all Gram rows are from messages
        return None
    with open_grams(warehouse, cohort.feature_set, cohort.predicate) as opened:
        rows = opened.label_sources(cohort.predicate)
    stated = [(n, _stated_rad(source, campaign, warehouse.configs)) for source, campaign, n in rows]
    total = sum(n for n, _ in stated)
    if not total or any(std is None for _, std in stated):
        return None
    variance = sum(n * std**2 for n, std in stated if std is not None) / total
    signals = warehouse.catalog.signals
    step = float(signals[signals.label].scale)
    return math.degrees(math.sqrt(variance + step**2 / 12))


def _stated_rad(source: str, campaign: str | None, configs: Configs) -> float | None:
    """Return the noise that a campaign states; None for measured drives and unknown campaigns."""
    if source != "simulated" or campaign is None:
        return None
    try:
        content = load_toml(configs.find("campaigns", campaign))
        if "sensors" not in content:
            content = load_toml(configs.find("campaigns", content["base"]))
        return float(content["sensors"]["sideslip_std_rad"])
    except (ConfigError, KeyError):  # its file is not among the configs
        return None
