"""Segments of measured drives that are held out, and models that are trained without them.

Segments are whole drives, or quarters of each drive's time where there are few, and kinds of
driving. The columns of a model are chosen on the Gram rows of the other segments, by its recipe.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.columns.drive_columns import ColumnPlan
from fleet_slip.errors import DataError
from fleet_slip.evaluation.filters import choose_evenly
from fleet_slip.evaluation.single_track import LabelledDrive, read_drive
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import Cohort, load_cohort, with_gram_rows
from fleet_slip.grams.drive_sums import DriveBlocks, counts_of, drive_sums, gram_rows
from fleet_slip.models.predict import Predictor
from fleet_slip.models.publish import manifest_of, with_straight_intercept
from fleet_slip.models.request import SelectionPlan, SelectionRequest
from fleet_slip.models.select import MIN_DRIVES, deal_trips, select_without
from fleet_slip.models.summary import Selection
from fleet_slip.views import open_views
from fleet_slip.warehouse.warehouse import Warehouse

# Segments of drives: a drive and a quarter of its time. All four quarters are a whole drive.

QUARTERS = 4
SPEEDS_MPS = (8.0, 15.0, 25.0)
LATERAL_MPS2 = (1.0, 2.5, 4.0)
"""Limits between kinds of driving, by mean speed and by root mean square of ay."""

NOMINAL_RADIUS_M = 0.31
"""Radius of a tyre, to classify kinds of driving."""

Segments = frozenset[tuple[str, int]]
"""Segments held out together: name of a drive, and quarter of its time from 0."""


@dataclass(frozen=True, kw_only=True)
class HeldOutDrive(LabelledDrive):
    """A measured drive with its label, its rows as logged, and its trip."""

    rows: pa.Table
    trip: str

    @property
    def name(self) -> str:
        """Identifier of the drive."""
        return self.drive_id

    @property
    def evaluated(self) -> BoolArray:
        """Rows with a label."""
        return np.isfinite(self.sideslip_rad)

    @cached_property
    def quarter(self) -> IntArray:
        """Quarter of the drive's time, by row."""
        return np.arange(len(self.rows)) * QUARTERS // len(self.rows)

    @cached_property
    def kind(self) -> str:
        """Kind of driving, by `SPEEDS_MPS` and `LATERAL_MPS2`."""
        signals = self.signals
        wheel = _first_logged(signals.wheel_rl_rad_s, signals.wheel_fl_rad_s)
        lateral = _first_logged(signals.ay_mps2)
        words = []
        if len(wheel):
            words.append(f"{_band(float(wheel.mean()) * NOMINAL_RADIUS_M, SPEEDS_MPS)} m/s")
        if len(lateral):
            size = float(np.sqrt(np.mean(lateral**2)))
            words.append(f"ay {_band(size, LATERAL_MPS2)} m/s²")
        return ", ".join(words)

    def rows_in(self, segments: Segments) -> BoolArray:
        """Return the mask of rows in segments."""
        return np.isin(self.quarter, [part for name, part in segments if name == self.name])

    def without(self, segments: Segments) -> LabelledDrive:
        """Return the drive without the labels of segments."""
        label = np.where(self.rows_in(segments), np.nan, self.sideslip_rad)
        return LabelledDrive(self.drive_id, self.signals, label)


def _first_logged(*signals: FloatArray) -> FloatArray:
    """Return the values of the first signal that has any."""
    values = [signal[np.isfinite(signal)] for signal in signals]
    return next((logged for logged in values if len(logged)), values[0])


def _band(value: float, edges: Sequence[float]) -> str:
    names = [f"below {edges[0]:g}"]
    names += [f"{lower:g} to {upper:g}" for lower, upper in pairwise(edges)]
    return [*names, f"above {edges[-1]:g}"][int(np.searchsorted(edges, value, side="right"))]


def _segments(
    drives: Iterable[HeldOutDrive], quarters: Iterable[int] = range(QUARTERS)
) -> Segments:
    return frozenset((drive.name, quarter) for drive in drives for quarter in quarters)


def folds_of(drives: Sequence[HeldOutDrive]) -> list[Segments]:
    """Return the folds: whole drives, together with all of their trip, or quarters."""
    trips = [drive.trip for drive in drives]
    if len(set(trips)) < MIN_DRIVES:
        return [_segments(drives, [quarter]) for quarter in range(QUARTERS)]
    groups = deal_trips(trips)
    return [
        _segments(drive for drive, group in zip(drives, groups, strict=True) if group == fold)
        for fold in range(max(groups) + 1)
    ]


def folds_by_kind(drives: Sequence[HeldOutDrive]) -> dict[str, Segments]:
    """Return the drives of each kind of driving; empty if all are of one kind."""
    kinds = sorted({drive.kind for drive in drives})
    if len(kinds) < 2:
        return {}
    return {kind: _segments(drive for drive in drives if drive.kind == kind) for kind in kinds}


# Regressions: chosen and fitted on the Gram rows of the training segments.


@dataclass(frozen=True)
class Learner:
    """A model that is trained again without held-out segments, by its own recipe.

    Attributes
    ----------
    plan
        Recipe of the model.
    cohort
        Gram rows of all drives.
    drives
        Their rows as logged, with the label.
    warehouse
        Data from which a label-free model takes its intercept.
    """

    plan: SelectionPlan
    cohort: Cohort
    drives: Sequence[HeldOutDrive]
    warehouse: Warehouse

    @classmethod
    def prepare(
        cls,
        warehouse: Warehouse,
        request: SelectionRequest,
        predicate: str,
        drives: Sequence[HeldOutDrive],
    ) -> "Learner":
        """Prepare a model's recipe for the drives of a cohort. Raises as `load_cohort`."""
        plan = SelectionPlan.from_request(warehouse.catalog, request)
        cohort = load_cohort(warehouse, predicate, plan.feature_set)
        return cls(plan, cohort, drives, warehouse)

    @cached_property
    def quarters(self) -> Cohort:
        """Gram rows of each quarter of each drive, by the column `quarter`."""
        catalog, name = self.warehouse.catalog, self.plan.feature_set
        feature_set, label = catalog.feature_set(name), catalog.signals.label
        if feature_set.change_ticks:
            raise DataError("a label-free model needs three drives or more: add some.")
        plan = ColumnPlan.of_set(catalog, name)
        blocks = DriveBlocks.of_set(feature_set)
        attributes = {row["drive_id"]: row for row in self.cohort.drives.to_pylist()}
        rows = [
            row
            for drive in self.drives
            for quarter in range(QUARTERS)
            for row in _gram_rows(label, plan, blocks, drive, quarter, attributes[drive.name])
        ]
        of_quarter = [("quarter", pa.int64()), ("sums", _SUMS), ("products", _SUMS)]
        schema = pa.schema([*self.cohort.drives.schema, *of_quarter])
        return with_gram_rows(self.cohort, pa.Table.from_pylist(rows, schema=schema))

    def choose(self, held_out: Segments, prior: Cohort | None = None) -> Selection:
        """Choose a model as `publish` does on the segments that are not held out.

        The folds are trips where the key of the recipe has one value, and quarters of a single
        trip, on which `publish` refuses. Quarters never count as drives.
        """
        training = _segments(self.drives) - held_out
        names = {name for name, _ in training}
        trips = {drive.trip for drive in self.drives if drive.name in names}
        if len(training) == QUARTERS * len(names) and len(trips) > 1:
            cohort = self.cohort
            left_out = ~np.isin(cohort.drives["drive_id"].to_pylist(), [*names])
        else:
            cohort = self.quarters
            left_out = np.array([segment not in training for segment in _segments_of(cohort)])
        if len(trips) == 1:
            cohort = replace(cohort, drives=_quarters_as_trips(cohort))
        return select_without(replace(cohort, prior=prior), self.plan, left_out)

    def train(self, held_out: Segments, prior: Cohort | None = None) -> tuple[list[str], Predictor]:
        """Train without held-out segments; return the chosen columns and the model."""
        selection = self.choose(held_out, prior)
        manifest = with_straight_intercept(self.warehouse, manifest_of(selection, "left_out"))
        return [*selection.winner.model.signals], Predictor.from_manifest(
            self.warehouse.catalog.signals, manifest
        )


_SUMS = pa.list_(pa.int64())


def _segments_of(quarters: Cohort) -> list[tuple[str, int]]:
    columns = (quarters.drives[name].to_pylist() for name in ("drive_id", "quarter"))
    return list(zip(*columns, strict=True))


def _quarters_as_trips(quarters: Cohort) -> pa.Table:
    """Return the metadata of Gram rows with each quarter of the time as a trip, hence a fold."""
    names = [f"quarter {quarter + 1}" for _, quarter in _segments_of(quarters)]
    column = quarters.drives.schema.get_field_index("trip")
    return quarters.drives.set_column(column, "trip", pa.array(names))


def _gram_rows(
    label: str,
    plan: ColumnPlan,
    blocks: DriveBlocks,
    drive: HeldOutDrive,
    quarter: int,
    attributes: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Return the Gram rows of a quarter's labelled rows; columns look back beyond it."""
    counts = counts_of(drive.rows, plan, attributes)
    labelled = counts.present.get(label, np.ones(len(drive.rows), dtype=np.bool_))
    present = {**counts.present, label: labelled & (drive.quarter == quarter)}
    sums = drive_sums(plan, blocks, replace(counts, present=present))
    rows = gram_rows(sums, plan.names, blocks, {**attributes, "quarter": quarter})
    return [row for row in rows if label in row["signals"].split(",")]


def predict_drive(model: Predictor, cars: CarCounts, drive: HeldOutDrive) -> FloatArray:
    """Estimate a drive by a model, shape (rows,)."""
    numbers = cars.get(drive.rows["vehicle_id"][0].as_py())
    return model(counts_of(drive.rows, model.plan, None, numbers))


MAX_DRIVES = 96
"""Drives to evaluate of a larger cohort, evenly chosen."""


def read_measured_drives(warehouse: Warehouse, cohort: Cohort) -> list[HeldOutDrive]:
    """Read drives of a cohort, at most `MAX_DRIVES`. Raises `DataError` if none has a label."""
    trips = {row["drive_id"]: row["trip"] for row in cohort.drives.to_pylist()}
    drives: list[HeldOutDrive] = []
    query = "SELECT * FROM log_counts WHERE drive_id = $drive ORDER BY tick"
    with open_views(warehouse, "SELECT 1 FROM log, log_counts") as database:
        for name in choose_evenly(sorted(trips), MAX_DRIVES):
            drive = read_drive(warehouse.catalog.signals, database, name)
            if np.isfinite(drive.sideslip_rad).any():
                rows = database.sql(query, params={"drive": name}).to_arrow_table()
                drives.append(HeldOutDrive(**vars(drive), rows=rows, trip=trips[name]))
    if not drives:
        raise DataError(
            "no drive of the cohort has the side-slip angle, the reference of every RMSE. Choose "
            "drives with that label."
        )
    return drives
