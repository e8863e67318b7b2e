"""Data roots with drives of eight cars, and the publication of a model."""

from typing import Any

import numpy as np

from fleet_slip.grams.update import update_grams
from fleet_slip.models.publish import Publication, manifest_of, publish_challenger, would_publish
from fleet_slip.models.registry import Registry
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import run_selection
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.logs import land, log_rows

ROWS = 200


WEAK = ("ax", "steering_wheel", "steer_fl")
"""Signals of which each is 0.023 deg of the label, which is not worth refusing."""


CHOICE = ("ay", "yaw_rate", "wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
"""Two signals that say something, and four that do not."""


def counts(rng: np.random.Generator, label: float = 1.0, noise: float = 20.0) -> dict[str, Any]:
    """Counts of a drive whose label is a sum of two signals, times a factor, and noise."""
    ay, yaw_rate, *weak = rng.normal(0, 1000, (2 + len(WEAK), ROWS))
    true = 0.3 * ay + 0.2 * yaw_rate + 0.004 * sum(weak)
    sideslip = label * true + rng.normal(0, noise, ROWS)
    columns: dict[str, Any] = {"ay": ay, "yaw_rate": yaw_rate, **dict(zip(WEAK, weak, strict=True))}
    columns |= dict(zip(CHOICE[2:], rng.normal(0, 1000, (4, ROWS)), strict=True))
    columns["sideslip"] = sideslip
    return {name: np.rint(values).astype(np.int16) for name, values in columns.items()}


def write(
    warehouse: Warehouse,
    name: str,
    drives: int,
    label: float = 1.0,
    noise: float = 20.0,
    **about: Any,
) -> None:
    """Land drives of eight cars and reduce them."""
    rng = np.random.default_rng([*name.encode()])
    rows = [
        log_rows(f"{name}-{i}", counts(rng, label, noise), vehicle_id=f"car-{i % 8}", **about)
        for i in range(drives)
    ]
    land(warehouse, name, *rows)
    update_grams(warehouse)


def publish_from(
    warehouse: Warehouse, cohort: str = "true", signals: str = "ay,yaw_rate", **options: Any
) -> Publication:
    """Select on a cohort and publish the winner, of which a dry run said what it comes to."""
    answer = run_selection(
        warehouse, SelectionRequest(order=signals, tolerance="0.0001deg"), cohort
    )
    manifest = manifest_of(answer, "beta")
    decision = would_publish(registry_of(warehouse), manifest, answer, **options)
    done = publish_challenger(registry_of(warehouse), manifest, answer, **options)
    assert (decision.publishes, decision.candidate) == (done.new, done.candidate)
    return done


def registry_of(warehouse: Warehouse) -> Registry:
    return Registry(warehouse.root, CATALOG)
