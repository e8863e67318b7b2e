"""The columns of models on measured drives with a label, and which part of them is left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveColumns
from fleet_slip.comparison.evaluation.estimators import TABLE_ONE
from fleet_slip.comparison.observers.drive_signals import LabelledDrive, read_drive
from fleet_slip.comparison.observers.identification import FOLDS
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.expansion import CarCounts
from fleet_slip.grams.rows.drive_rows import counts_of
from fleet_slip.models.estimates.predictor import Predictor
from fleet_slip.models.estimates.score import calibrated_cars
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.seen_drives import find_seen
from fleet_slip.models.versions import Registry
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Design:
    """The columns of a model, to be fitted anew; `published`, a version as it is, needs no fit."""

    plan: ColumnPlan
    scales: tuple[float, ...]
    intercept: bool = True
    published: Predictor | None = None


@dataclass(frozen=True)
class OwnDrive:
    """A drive: its signals and label, each design's columns (rows, n), and the part of each row."""

    drive: LabelledDrive
    columns: Mapping[str, FloatArray]
    part: IntArray

    def without(self, part: int) -> LabelledDrive:
        """Return the drive without the labels of a part."""
        label = np.where(self.part == part, np.nan, self.drive.sideslip_rad)
        return replace(self.drive, sideslip_rad=label)


def designs_of(
    warehouse: Warehouse, versions: Sequence[ModelVersion], condition: str
) -> dict[str, Design]:
    """Return the models of Table I and versions; who saw none of the labels stays as it is."""
    designs = {
        f"table1/{one.name}": Design(
            ColumnPlan.of(one.signals, {}, {}),
            tuple(float(catalogue()[signal].scale) for signal in one.signals),
        )
        for one in load_model_list(TABLE_ONE).model
    }
    registry = Registry.of(warehouse)
    for version in versions:
        manifest, model = version.manifest, Predictor.of(version.manifest)
        from_course = manifest.learned_from is not None and manifest.learned_from.weight is None
        made = from_course or find_seen(warehouse, registry, manifest, condition).trained == 0
        designs[version.reference] = Design(
            model.plan, model.scales, not manifest.through_origin, model if made else None
        )
    return designs


def read_own_drives(
    warehouse: Warehouse, names: Sequence[str], designs: Mapping[str, Design]
) -> list[OwnDrive]:
    """Read drives with their designs' columns. Raises `DataError` where none has a label."""
    drives: list[OwnDrive] = []
    cars: CarCounts = {}
    if any(design.plan.numbers for design in designs.values()):
        cars = calibrated_cars(warehouse)
    needed = [
        *(name for design in designs.values() for name in design.plan.signals),
        *(name for design in designs.values() for name in design.plan.facts),
    ]
    wanted = ", ".join(dict.fromkeys(("tick", "vehicle_id", *needed)))
    query = f"SELECT {wanted} FROM log_counts WHERE drive_id = $drive ORDER BY tick"
    with connect(warehouse.root, query="SELECT 1 FROM log, log_counts") as database:
        for name in names:
            drive = read_drive(database, name)
            if not np.isfinite(drive.sideslip_rad).any():
                continue
            rows = database.sql(query, params={"drive": name}).to_arrow_table()
            numbers = cars.get(rows["vehicle_id"][0].as_py())
            columns = {}
            for model, one in designs.items():
                counts = counts_of(rows, one.plan, None, numbers)
                if one.published is not None:
                    columns[model] = one.published(counts)[:, None]
                else:
                    scales = np.array(one.scales)[:, None]
                    columns[model] = (DriveColumns(one.plan, counts).compute() * scales).T
            drives.append(OwnDrive(drive, columns, np.full(len(rows), len(drives) % FOLDS)))
    if not drives:
        raise DataError(
            "no drive of the cohort has side-slip, by which estimators are judged. Choose drives "
            "with that label."
        )
    if len(drives) >= FOLDS:
        return drives
    return [replace(one, part=np.arange(len(one.part)) * FOLDS // len(one.part)) for one in drives]
