"""The drives of a cohort again with a label that is exact, to judge by what was taught with errors.

Only the reference sensor differs: its noise, place, angle, bandwidth and delay are none. All other
sensors draw the same noise, and log the same bits, which is checked.
"""

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import fleet_slip
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import load_config
from fleet_slip.regression.exact.figures import Figures
from fleet_slip.regression.validation.crossval import held_out_errors, least_squares
from fleet_slip.regression.validation.folds import CohortFolds
from fleet_slip.resources import find_config
from fleet_slip.simulation.campaign import Campaign, DriveSpec
from fleet_slip.simulation.imperfections import SensorImperfections
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse

NO_SPEED_MPS = 1e-12
"""Noise below every count, that is drawn all the same: satellite velocity's is drawn after it."""

ROWS = """
SELECT count(*), bit_xor(hash(measured))
FROM (
    SELECT {columns}
    FROM log_counts
    WHERE drive_id IN (SELECT drive_id FROM drives WHERE {cohort})
) AS measured
"""


class ExactlyLabelled(Campaign):
    """A campaign whose reference sensor makes no error."""

    def drives(self, day: date) -> tuple[DriveSpec, ...]:
        """Return the campaign's drives, of the same cars on the same roads, with an exact label."""
        return tuple(with_exact_label(spec) for spec in super().drives(day))


def with_exact_label(spec: DriveSpec) -> DriveSpec:
    """Return the drive with a label that is the angle itself, rounded to its count."""
    before = spec.flaws.sensors
    exact = {
        name: field.default
        for name, field in SensorImperfections.model_fields.items()
        if name.startswith("label_")
    }
    if before.label_velocity_std_mps:
        exact["label_velocity_std_mps"] = NO_SPEED_MPS
    seen = before.model_copy(update=exact)
    return replace(
        spec,
        sensors=spec.sensors.model_copy(update={"sideslip_std_rad": 0.0}),
        flaws=spec.flaws.model_copy(update={"sensors": seen}),
    )


def simulate_exactly(
    warehouse: Warehouse, cohort: str, feature_set: str, folder: Path
) -> Warehouse:
    """Simulate the days of a cohort of one campaign into a folder, with Gram rows of a set.

    Raises `RuntimeError` if any other sensor logged other bits than in the warehouse.
    """
    with connect(warehouse.root) as database:
        query = f"SELECT DISTINCT campaign, max(day) OVER () FROM drives WHERE {cohort}"
        [(campaign, last)] = database.execute(query).fetchall()
    fleet = fleet_slip.open(folder)
    fleet.simulate(load_config(find_config("campaigns", campaign), ExactlyLabelled), through=last)
    fleet.gram(feature_set)
    with connect(fleet.root) as database:
        described = database.execute("DESCRIBE log_counts").fetchall()
    label_itself = {catalogue().label, "saturated"}
    columns = [name for name, *_ in described if name not in label_itself]
    real, exact = (_fingerprint(root, cohort, columns) for root in (warehouse.root, fleet.root))
    if real != exact:
        raise RuntimeError(f"not the same drives but for the label: {real}, {exact}")
    return fleet.warehouse


def _fingerprint(root: Any, cohort: str, columns: Sequence[str]) -> tuple[int, int]:
    """Return the number of rows, and the hash of what all sensors but the label's logged."""
    quoted = ", ".join(f'"{name}"' for name in columns)
    with connect(root) as database:
        query = ROWS.format(columns=quoted, cohort=cohort)
        [(rows, fingerprint)] = database.execute(query).fetchall()
    return rows, fingerprint


def judge(
    taught: CohortFolds, judges: Sequence[CohortFolds], inputs: Sequence[str]
) -> list[Figures]:
    """Cross-validate least squares by the labels of each judge, on the folds that are held out."""
    label = catalogue().label
    procedure = least_squares(inputs, label)
    folds = taught.serving(inputs, label)
    tests = [judge.serving(inputs, label) for judge in judges]
    if any(one.names != folds.names for one in tests):
        raise RuntimeError("not the same cars")
    errors: list[list[Any]] = [[] for _ in judges]
    for fold, (training, _) in enumerate(folds.splits()):
        model = procedure(training)
        for found, test in zip(errors, tests, strict=True):
            found.append(held_out_errors(model, training, test.grams[fold]))
    return [sum(found[1:], found[0]).figures(input_scales()[label]) for found in errors]
