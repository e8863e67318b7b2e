"""Models that are trained without held-out segments of measured drives, also with a filter.

Segments are whole drives, or quarters of each drive's time where there are few, and kinds of
driving. The columns of a model are chosen on the Gram rows of the other segments, by its recipe.

The weights of a combination of line and filter are cross-validated in inner groups of drives. In
every group the car is identified, and the line chosen and fitted, without the group. So the weights
come from estimates that have not seen the labels.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.columns.drive_columns import ColumnPlan
from fleet_slip.errors import DataError
from fleet_slip.evaluation.evaluator import Estimator
from fleet_slip.evaluation.filters import TUNING_DRIVES, TUNING_S, choose_evenly
from fleet_slip.evaluation.identify import IdentifiedVehicle, identify
from fleet_slip.evaluation.labelled_drives import (
    QUARTERS,
    LabelledDrive,
    Segments,
    hold_last,
    predict_drive,
    read_drives,
)
from fleet_slip.evaluation.test_drives import TestDrive
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import Cohort, load_cohort, with_gram_rows
from fleet_slip.grams.compute import DriveBlocks, counts_of, drive_sums, gram_rows
from fleet_slip.models.predict import Predictor
from fleet_slip.models.publish import manifest_of, with_straight_intercept
from fleet_slip.models.request import SelectionPlan, SelectionRequest
from fleet_slip.models.select import MIN_DRIVES, deal_trips, select_without
from fleet_slip.models.summary import Selection
from fleet_slip.regression.combination import (
    CombinationChoice,
    EstimateCombination,
    PairedEstimates,
    choose_combination,
)
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.measures import VehicleMeasures
from fleet_slip.warehouse.warehouse import Warehouse

MAX_DRIVES = 96
"""Drives to evaluate of a larger cohort, evenly chosen."""


def read_measured_drives(warehouse: Warehouse, cohort: Cohort) -> list[LabelledDrive]:
    """Read drives of a cohort, at most `MAX_DRIVES`. Raises `DataError` if none has a label."""
    trips = {row["drive_id"]: row["trip"] for row in cohort.drives.to_pylist()}
    drives = [
        replace(drive, trip=trips[drive.name])
        for drive in read_drives(warehouse, choose_evenly(sorted(trips), MAX_DRIVES))
        if drive.evaluated.any()
    ]
    if not drives:
        raise DataError(
            "no drive of the cohort has the side-slip angle, the reference of every RMSE. Choose "
            "drives with that label."
        )
    return drives


def segments_of(
    drives: Iterable[LabelledDrive], quarters: Iterable[int] = range(QUARTERS)
) -> Segments:
    """Return quarters of drives, by default whole drives."""
    return frozenset((drive.name, quarter) for drive in drives for quarter in quarters)


def folds_of(drives: Sequence[LabelledDrive]) -> list[Segments]:
    """Return the folds: whole drives, together with all of their trip, or quarters."""
    trips = [drive.trip for drive in drives]
    if len(set(trips)) < MIN_DRIVES:
        return [segments_of(drives, [quarter]) for quarter in range(QUARTERS)]
    groups = deal_trips(trips)
    return [
        segments_of(drive for drive, group in zip(drives, groups, strict=True) if group == fold)
        for fold in range(max(groups) + 1)
    ]


def folds_by_kind(drives: Sequence[LabelledDrive]) -> dict[str, Segments]:
    """Return the drives of each kind of driving; empty if all are of one kind."""
    kinds = sorted({drive.kind for drive in drives})
    if len(kinds) < 2:
        return {}
    return {kind: segments_of(drive for drive in drives if drive.kind == kind) for kind in kinds}


def training_drives(drives: Sequence[LabelledDrive], held_out: Segments) -> list[LabelledDrive]:
    """Return the labelled drives without held-out segments; of many, the beginnings of some."""
    training = [drive.without(held_out) for drive in drives]
    training = [drive for drive in training if drive.evaluated.any()]
    rows = TUNING_S * SAMPLE_RATE_HZ
    if sum(len(drive.signals) for drive in training) > TUNING_DRIVES * rows:
        training = [drive.beginning(rows) for drive in choose_evenly(training, TUNING_DRIVES)]
    return training


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
    drives: Sequence[LabelledDrive]
    warehouse: Warehouse

    @classmethod
    def prepare(
        cls,
        warehouse: Warehouse,
        request: SelectionRequest,
        predicate: str,
        drives: Sequence[LabelledDrive],
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
        sums = pa.list_(pa.int64())
        of_quarter = [("quarter", pa.int64()), ("sums", sums), ("products", sums)]
        schema = pa.schema([*self.cohort.drives.schema, *of_quarter])
        return with_gram_rows(self.cohort, pa.Table.from_pylist(rows, schema=schema))

    def choose(self, held_out: Segments, prior: Cohort | None = None) -> Selection:
        """Choose a model as `publish` does on the segments that are not held out.

        The folds are trips where the key of the recipe has one value, and quarters of a single
        trip, on which `publish` refuses. Quarters never count as drives.
        """
        training = segments_of(self.drives) - held_out
        names = {name for name, _ in training}
        trips = {drive.trip for drive in self.drives if drive.name in names}
        if len(training) == QUARTERS * len(names) and len(trips) > 1:
            cohort = self.cohort
            left_out = ~np.isin(cohort.drives["drive_id"].to_pylist(), [*names])
        else:
            cohort = self.quarters
            keys = cohort.drives.select(["drive_id", "quarter"]).to_pylist()
            left_out = np.array([tuple(key.values()) not in training for key in keys])
        if len(trips) == 1:  # each quarter of the time is a trip, hence a fold
            quarters = [
                f"quarter {quarter + 1}" for quarter in cohort.drives["quarter"].to_pylist()
            ]
            column = cohort.drives.schema.get_field_index("trip")
            drives = cohort.drives.set_column(column, "trip", pa.array(quarters))
            cohort = replace(cohort, drives=drives)
        return select_without(replace(cohort, prior=prior), self.plan, left_out)

    def train(self, held_out: Segments, prior: Cohort | None = None) -> tuple[list[str], Predictor]:
        """Train without held-out segments; return the chosen columns and the model."""
        selection = self.choose(held_out, prior)
        manifest = with_straight_intercept(self.warehouse, manifest_of(selection, "left_out"))
        return [*selection.winner.model.signals], Predictor.from_manifest(
            self.warehouse.catalog.signals, manifest
        )


def _gram_rows(
    label: str,
    plan: ColumnPlan,
    blocks: DriveBlocks,
    drive: LabelledDrive,
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


# Combinations of a line and a filter.

MAX_GROUPS = 4
"""Inner groups of drives, each held out in turn."""

LATERAL_ROWS = 32
"""Rows of the mean of the lateral acceleration that shares depend on."""


def lateral_mps2(ay_mps2: FloatArray) -> FloatArray:
    """Return the size of the lateral acceleration, a mean of the last `LATERAL_ROWS` rows."""
    sums = np.cumsum(hold_last(ay_mps2, "ay"))
    before = np.concatenate([np.zeros(LATERAL_ROWS), sums])[: len(sums)]
    size: FloatArray = np.abs(sums - before) / np.minimum(np.arange(len(sums)) + 1, LATERAL_ROWS)
    return size


def combined_estimate(
    combination: EstimateCombination,
    line: Estimator[Any],
    filtered: Estimator[Any],
    drive: LabelledDrive | TestDrive,
) -> FloatArray:
    """Combine the estimates of a line and a filter; the line's where the filter has none."""
    line_rad, filter_rad = line(drive), filtered(drive)
    combined = combination(line_rad, filter_rad, lateral_mps2(drive.ay_mps2))
    return np.where(np.isnan(filter_rad), line_rad, combined)


def pair_estimates(
    drive: LabelledDrive,
    line: Estimator[LabelledDrive],
    filtered: Estimator[LabelledDrive],
    rows: BoolArray,
    group: int,
) -> PairedEstimates:
    """Return both estimates of the rows of a mask that have them and a label."""
    estimates, label = (line(drive), filtered(drive)), drive.sideslip_rad
    groups = np.full(len(label), float(group))
    pairs = PairedEstimates(*estimates, label, lateral_mps2(drive.ay_mps2), groups)
    return pairs.where(rows & np.isfinite(estimates[0] + estimates[1] + label))


@dataclass(frozen=True)
class CombinedModel:
    """A line and a filter in the identified car, both fitted to all training segments."""

    choice: CombinationChoice
    """The combination and its comparison."""
    estimate: Estimator[LabelledDrive]
    vehicle: IdentifiedVehicle


def combine(
    learner: Learner,
    measures: VehicleMeasures,
    held_out: Segments,
    executor: Executor,
    *,
    cars: CarCounts,
    identified: IdentifiedVehicle | None = None,
    prior: Cohort | None = None,
) -> CombinedModel:
    """Choose a combination without held-out segments.

    `identified` is the car without these segments, if it is available. Raises `DataError` without
    labels, or without a signal that the filter needs, and as `Learner.train`.
    """
    drives = learner.drives
    identified = identified or identify(measures, training_drives(drives, held_out), executor)
    _, line = learner.train(held_out, prior)
    groups, kinds = inner_groups(drives, held_out)
    parts: list[list[PairedEstimates]] = []
    for number, group in enumerate([*groups, *kinds]):
        without = held_out | group
        vehicle = identify(measures, training_drives(drives, without), executor, start=identified)
        _, model = learner.train(without, prior)
        estimators = partial(predict_drive, model, cars), vehicle.estimate_drive
        masks = [(drive, drive.rows_in(group) & drive.evaluated) for drive in drives]
        parts.append(
            [
                pair_estimates(drive, *estimators, rows, number)
                for drive, rows in masks
                if rows.any()
            ]
        )
    pairs, pairs_of_kinds = (
        [part for group in selected for part in group]
        for selected in (parts[: len(groups)], parts[len(groups) :])
    )
    if not pairs:
        raise DataError("no inner group has rows with a label and both estimates.")
    choice = choose_combination(
        PairedEstimates.concatenate(pairs),
        PairedEstimates.concatenate(pairs_of_kinds) if pairs_of_kinds else None,
    )
    both = partial(predict_drive, line, cars), identified.estimate_drive
    return CombinedModel(choice, partial(combined_estimate, choice.combination, *both), identified)


def inner_groups(
    drives: Sequence[LabelledDrive], held_out: Segments
) -> tuple[list[Segments], list[Segments]]:
    """Divide the training segments into groups of trips, and into kinds of driving.

    A single trip is divided into quarters of time. A kind that is a group of trips is left out.
    """
    training = segments_of(drives) - held_out
    trips = {drive.name: drive.trip for drive in drives}
    names = list(dict.fromkeys(trips[name] for name in trips if (name, 0) in training))
    has_whole_drives = len(training) == QUARTERS * len({name for name, _ in training})
    if has_whole_drives and len(names) > 1:
        count = min(len(names), MAX_GROUPS)
        groups = [
            frozenset(part for part in training if names.index(trips[part[0]]) % count == group)
            for group in range(count)
        ]
    else:
        quarters = sorted({quarter for _, quarter in training})
        groups = [frozenset(part for part in training if part[1] == q) for q in quarters]
    kinds = folds_by_kind([drive for drive in drives if (drive.name, 0) in training])
    return groups, [kind for kind in kinds.values() if has_whole_drives and kind not in groups]
