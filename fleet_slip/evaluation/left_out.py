"""What is left out of measured drives in turn, and models that are learned from the rest.

Left out are whole drives, or quarters of each drive's time where there are few, and kinds of
driving. A model's columns are chosen on the Gram rows of what is left in, by its own recipe.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.columns.drive_columns import Workspace
from fleet_slip.columns.plan import ColumnPlan
from fleet_slip.errors import DataError
from fleet_slip.evaluation.filters import choose_evenly
from fleet_slip.evaluation.single_track import LabelledDrive, read_drive
from fleet_slip.grams.cohort import Cohort, load_cohort, with_gram_rows
from fleet_slip.grams.compute import Parts, counts_of, drive_sums, gram_rows
from fleet_slip.grams.expansion import CarCounts
from fleet_slip.grams.folding import FOLD_KEYS, Folding
from fleet_slip.grams.gram_files import hash_names
from fleet_slip.models.predict import Predictor
from fleet_slip.models.publish import manifest_of, with_straight_intercept
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import Selection, SelectionPlan
from fleet_slip.views import open_views
from fleet_slip.warehouse.tables import Warehouse

# What is left out: units of a drive and a quarter of its time, of which all four are a whole drive.

QUARTERS = 4
FEWEST_DRIVES = 3
"""Of fewer, quarters of their time are left out, not whole drives."""

MOST_FOLDS = 10
DEALT_FOLDS = 8
"""Each of up to so many drives is left out by itself; more are dealt into so many groups."""

SPEEDS_MPS = (8.0, 15.0, 25.0)
LATERAL_MPS2 = (1.0, 2.5, 4.0)
"""Between these a drive's mean speed, and the root mean square of its ay, are of one kind."""

LeftOut = frozenset[tuple[int, int]]
"""Drives and quarters of them, both numbered from 0."""


@dataclass(frozen=True)
class HeldOutDrive:
    """A drive: its signals and label, its rows as logged, and its trip."""

    drive: LabelledDrive
    rows: pa.Table
    trip: str

    @cached_property
    def quarter(self) -> IntArray:
        """The quarter of its time that each row is in."""
        return np.arange(len(self.rows)) * QUARTERS // len(self.rows)

    @cached_property
    def kind(self) -> str:
        """How it was driven, by `SPEEDS_MPS` and `LATERAL_MPS2`."""
        signals = self.drive.signals
        wheel = _logged(signals.wheel_rl_rad_s, signals.wheel_fl_rad_s)
        lateral = _logged(signals.ay_mps2)
        words = []
        if len(wheel):
            words.append(f"{_band(float(wheel.mean()) * NOMINAL_RADIUS_M, SPEEDS_MPS)} m/s")
        if len(lateral):
            size = float(np.sqrt(np.mean(lateral**2)))
            words.append(f"ay {_band(size, LATERAL_MPS2)} m/s²")
        return ", ".join(words)

    def without(self, quarters: Sequence[int]) -> LabelledDrive:
        """Return the drive without the labels of some quarters."""
        label = np.where(np.isin(self.quarter, quarters), np.nan, self.drive.sideslip_rad)
        return replace(self.drive, sideslip_rad=label)


NOMINAL_RADIUS_M = 0.31
"""Of a tyre, to tell kinds of driving by."""


def _logged(*signals: FloatArray) -> FloatArray:
    """Return the values of the first of some signals that has any."""
    found = [one[np.isfinite(one)] for one in signals]
    return next((one for one in found if len(one)), found[0])


def _band(value: float, edges: Sequence[float]) -> str:
    names = [f"below {edges[0]:g}"]
    names += [f"{lower:g} to {upper:g}" for lower, upper in pairwise(edges)]
    return [*names, f"above {edges[-1]:g}"][int(np.searchsorted(edges, value, side="right"))]


def _whole(drives: Sequence[int]) -> LeftOut:
    return frozenset((drive, quarter) for drive in drives for quarter in range(QUARTERS))


def parts_to_leave_out(drives: Sequence[HeldOutDrive]) -> list[LeftOut]:
    """Return what is left out in turn: whole drives, with all of their trip, or quarters."""
    trips = list(dict.fromkeys(one.trip for one in drives))
    if len(trips) < FEWEST_DRIVES:
        every = range(len(drives))
        return [frozenset((drive, quarter) for drive in every) for quarter in range(QUARTERS)]
    groups = len(trips) if len(trips) <= MOST_FOLDS else DEALT_FOLDS
    group = [trips.index(one.trip) % groups for one in drives]
    return [_whole([i for i, own in enumerate(group) if own == one]) for one in range(groups)]


def kinds_to_leave_out(drives: Sequence[HeldOutDrive]) -> dict[str, LeftOut]:
    """Return the drives of each kind of driving; none if all are of one."""
    kinds = sorted({one.kind for one in drives})
    if len(kinds) < 2:
        return {}
    return {kind: _whole([i for i, one in enumerate(drives) if one.kind == kind]) for kind in kinds}


# Regressions: chosen and fitted on Gram rows of what is left in.


@dataclass(frozen=True)
class Learner:
    """A model that is learned anew from what is left in, by its own recipe.

    Attributes:
        plan: its recipe.
        cohort: the Gram rows of all drives.
        drives: their rows as logged, with the label.
        warehouse: what tells the intercept of a model that changes taught.
    """

    plan: SelectionPlan
    cohort: Cohort
    drives: Sequence[HeldOutDrive]
    warehouse: Warehouse

    @classmethod
    def of(
        cls,
        warehouse: Warehouse,
        request: SelectionRequest,
        condition: str,
        drives: Sequence[HeldOutDrive],
    ) -> "Learner":
        """Return a model by its recipe, to be learned from drives of a cohort.

        Raises as `load_cohort`.
        """
        plan = SelectionPlan.of(warehouse.catalog, request)
        cohort = load_cohort(warehouse, condition, plan.feature_set)
        return cls(plan, cohort, drives, warehouse)

    @cached_property
    def divided(self) -> Cohort:
        """The Gram rows of each quarter by itself, as if it were a drive."""
        catalog, name = self.warehouse.catalog, self.plan.feature_set
        feature_set, label = catalog.feature_set(name), catalog.signals.label
        if feature_set.change_ticks:
            raise DataError("a label-free model needs three drives or more: add some.")
        workspace = Workspace(ColumnPlan.of_set(catalog, name))
        parts = Parts.of_set(feature_set)
        lines = {line["drive_id"]: line for line in self.cohort.drives.to_pylist()}
        found = [
            row
            for one in self.drives
            for quarter in range(QUARTERS)
            for row in _gram_rows(label, workspace, parts, one, quarter, lines[one.drive.drive_id])
        ]
        stored = pa.schema([*self.cohort.drives.schema, ("sums", _SUMS), ("products", _SUMS)])
        return with_gram_rows(self.cohort, pa.Table.from_pylist(found, schema=stored))

    def choose(self, left_out: LeftOut, prior: Cohort | None = None) -> Selection:
        """Choose on what is left in, in folds of drives where its own key knows only one.

        Of a single drive that is left in, or of quarters, each quarter counts as a drive.
        """
        every = [(i, quarter) for i in range(len(self.drives)) for quarter in range(QUARTERS)]
        seen = [unit for unit in every if unit not in left_out]
        names = {self.drives[i].drive.drive_id for i, _ in seen}
        divided = len(seen) < QUARTERS * len(names) or len(names) < 2
        cohort, plan = self.cohort, self.plan
        if divided:
            cohort = self.divided
            names = {_quarter_of(self.drives[i].drive.drive_id, quarter) for i, quarter in seen}
        cohort = cohort.part(np.isin(cohort.drives["drive_id"].to_pylist(), [*names]))
        values = cohort.drives[FOLD_KEYS[plan.folds.by]].unique()
        if len(values) < 2:
            plan = replace(plan, folds=Folding(by="drive", count=plan.folds.count))
        return plan.choose(replace(cohort, prior=prior) if prior else cohort)

    def estimate(
        self, left_out: LeftOut, cars: CarCounts, prior: Cohort | None = None
    ) -> tuple[list[str], list[FloatArray]]:
        """Return the columns that are chosen without some parts, and an estimate of all drives."""
        selection = self.choose(left_out, prior)
        manifest = manifest_of(selection, "left_out")
        manifest = with_straight_intercept(self.warehouse, manifest)
        model = Predictor.of(self.warehouse.catalog.signals, manifest)
        apart = {i for i, _ in left_out}
        return [*selection.winner.model.signals], [
            predict_drive(model, one, cars) if i in apart else np.full(len(one.rows), np.nan)
            for i, one in enumerate(self.drives)
        ]


_SUMS = pa.list_(pa.int64())


def _quarter_of(drive_id: str, quarter: int) -> str:
    return f"{drive_id}, quarter {quarter + 1}"


def _gram_rows(
    label: str,
    workspace: Workspace,
    parts: Parts,
    one: HeldOutDrive,
    quarter: int,
    line: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Return the Gram rows of the labelled rows of a quarter; columns look back beyond it."""
    counts = counts_of(one.rows, workspace.plan, line)
    labelled = counts.present.get(label, np.ones(len(one.rows), dtype=np.bool_))
    present = {**counts.present, label: labelled & (one.quarter == quarter)}
    name = _quarter_of(one.drive.drive_id, quarter)
    (number,) = hash_names(pa.array([name])).tolist()
    own = {"drive_id": name, "trip": name, "drive_hash": number, "trip_hash": number}
    sums = drive_sums(workspace, parts, replace(counts, present=present))
    rows = gram_rows(sums, workspace.plan.names, parts, {**line, **own})
    return [row for row in rows if label in row["signals"].split(",")]


def predict_drive(model: Predictor, one: HeldOutDrive, cars: CarCounts) -> FloatArray:
    """Return what a model estimates of a drive, shape (rows,)."""
    numbers = cars.get(one.rows["vehicle_id"][0].as_py())
    return model(counts_of(one.rows, model.plan, None, numbers))


def read_measured_drives(warehouse: Warehouse, cohort: Cohort) -> list[HeldOutDrive]:
    """Read drives of a cohort, at most `DRIVES_AT_MOST`. Raises `DataError` if none has a label."""
    trips = {one["drive_id"]: one["trip"] for one in cohort.drives.to_pylist()}
    drives: list[HeldOutDrive] = []
    query = "SELECT * FROM log_counts WHERE drive_id = $drive ORDER BY tick"
    with open_views(warehouse, "SELECT 1 FROM log, log_counts") as database:
        for name in choose_evenly(sorted(trips), DRIVES_AT_MOST):
            drive = read_drive(warehouse.catalog.signals, database, name)
            if np.isfinite(drive.sideslip_rad).any():
                rows = database.sql(query, params={"drive": name}).to_arrow_table()
                drives.append(HeldOutDrive(drive, rows, trips[name]))
    if not drives:
        raise DataError(
            "no drive of the cohort has the side-slip angle, the reference of every RMSE. Choose "
            "drives with that label."
        )
    return drives


DRIVES_AT_MOST = 96
"""Of a larger cohort so many are estimated, evenly chosen."""
