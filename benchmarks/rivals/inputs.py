"""Inputs of learned rivals: logged signals, a model's columns, and a sample of a cohort's rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from benchmarks.rivals.learners import Fit, FittedLearner, Names, one_thread
from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.definitions import Definition
from fleet_slip.columns.drive_columns import ColumnPlan, DriveCounts, as_counts, compute_columns
from fleet_slip.errors import DataError
from fleet_slip.evaluation.evaluated_drives import TestDrive
from fleet_slip.evaluation.evaluator import ErrorStatistics, error_statistics
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import Cohort, assign_folds
from fleet_slip.grams.compute import read_drives
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.folds import FoldAssignment
from fleet_slip.warehouse.gram_reader import cohort_files
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS


@dataclass(frozen=True)
class Inputs:
    """Columns of counts, computed as those of the Gram rows are, and the value of a count.

    Attributes:
        scales: physical value of a count of each column, by name, in order.
        features: those of one row among what the columns are made of.
        definitions: those of the columns over time.
    """

    scales: Mapping[str, float]
    features: Mapping[str, Definition] = field(default_factory=dict)
    definitions: Mapping[str, Definition] = field(default_factory=dict)

    @classmethod
    def of_signals(cls, names: Sequence[str]) -> "Inputs":
        """Return logged signals as inputs."""
        return cls({name: float(SIGNALS[name].scale) for name in names})

    @classmethod
    def of_model(cls, manifest: Manifest, signals: Sequence[str]) -> "Inputs":
        """Return logged signals, and then what a published model sees and they are not.

        Of a gated column, the column without its gate, and the counts of what opens the gate: the
        product of both is what these learners make themselves.
        """
        scales = {name: float(SIGNALS[name].scale) for name in signals}
        definitions: dict[str, Definition] = {}
        for term in manifest.terms:
            scale = float(SIGNALS[term.signal].scale if term.logged else term.scale)
            definition = term.definition
            if definition is None:
                scales.setdefault(term.signal, scale)
                continue
            for part in definition.components:
                if part not in definitions.values():
                    behind = f"{part.of}_{part.over or 'now'}_{part.ticks}"  # a gate only
                    if behind in scales:
                        behind = f"{behind}_{len(scales)}"
                    name = term.signal if part == definition else behind
                    definitions[name] = part
                    scales[name] = 1.0 if definition.gate and part == definition.gate.by else scale
        return cls(scales, manifest.features, definitions)

    @property
    def names(self) -> tuple[str, ...]:
        """The columns' names."""
        return tuple(self.scales)

    @cached_property
    def plan(self) -> ColumnPlan:
        """The columns to compute for a drive."""
        return ColumnPlan.from_definitions(self.names, self.features, self.definitions)

    def beside(self, signal: str) -> "Inputs":
        """Return the same with a logged signal as the last one."""
        return replace(self, scales={**self.scales, signal: float(SIGNALS[signal].scale)})

    def values(self, drive: DriveCounts) -> FloatArray:
        """Return physical values, shape (rows, columns), NaN where missing. Raises `DataError`."""
        scales = np.array(list(self.scales.values()))
        return np.asarray((compute_columns(self.plan, drive) * scales[:, None]).T)


@dataclass(frozen=True)
class LearnedEstimate:
    """A fitted learner with its inputs."""

    inputs: Inputs
    fitted: FittedLearner

    def __call__(self, drive: TestDrive) -> FloatArray:
        """Estimate side-slip in rad at every tick; NaN where an input is missing."""
        return self.estimate(drive.columns, drive.vehicle_attributes)

    def estimate(
        self, signals: Mapping[str, FloatArray], attributes: Mapping[str, Any]
    ) -> FloatArray:
        """Estimate side-slip from signals by SI column and attributes of the vehicle."""
        plan = self.inputs.plan
        inputs = self.inputs.values(as_counts(SIGNALS, signals, plan.signals, attributes))
        complete = np.isfinite(inputs).all(axis=1)
        estimates = np.full(len(inputs), np.nan)
        if complete.any():
            with one_thread():
                estimates[complete] = self.fitted.predict(inputs[complete])
        return estimates


SAMPLE_ROWS = 60_000
"""Rows of a sample, about. Neighbours at 100 Hz say almost the same, so that little is lost."""


@dataclass(frozen=True)
class RowSample:
    """Rows evenly spaced over all drives: inputs in SI units, label, and the trip of each row."""

    names: tuple[str, ...]
    inputs: FloatArray
    sideslip_rad: FloatArray
    trip: Names

    def columns(self, names: tuple[str, ...]) -> FloatArray:
        """Return some of the inputs, shape (rows, inputs)."""
        return self.inputs[:, [self.names.index(name) for name in names]]

    def folds(self) -> FoldAssignment:
        """Divide the rows as the regression's cross-validation divides the drives."""
        return assign_folds(self.trip.tolist(), "drive", 5)

    def cross_validated(self, fit: Fit, names: tuple[str, ...]) -> ErrorStatistics:
        """Return the figures of a learner on rows that each fold's fit has not seen."""
        inputs, folds = self.columns(names), self.folds()
        estimates = np.full(len(inputs), np.nan)
        for fold in range(len(folds.names)):
            test = folds.fold == fold
            fitted = fit(inputs[~test], self.sideslip_rad[~test], self.trip[~test])
            estimates[test] = fitted.predict(inputs[test])
        return error_statistics(estimates, self.sideslip_rad, np.ones(len(inputs), dtype=np.bool_))


def draw_sample(
    warehouse: Warehouse,
    cohort: Cohort,
    inputs: Inputs,
    rows: int = SAMPLE_ROWS,
    numbers: CarCounts | None = None,
) -> RowSample:
    """Draw about so many rows with all inputs and the label, or raise `DataError`."""
    with_label = inputs.beside(SIGNALS.label)
    plan = with_label.plan
    trips = dict(zip(*(cohort.drives[n].to_pylist() for n in ("drive_id", "trip")), strict=True))
    stride = max(1, cohort.rows // rows)
    parts: list[FloatArray] = []
    names: list[str] = []
    files = cohort_files(warehouse, cohort.predicate)
    for file in (item for item in warehouse.logs.snapshot().files if item.path in files):
        for drive in read_drives(warehouse, file, plan):
            name = str(drive.facts["drive_id"])
            if name not in trips:
                continue
            calibration = (numbers or {}).get(str(drive.facts["vehicle_id"]), {})
            values = with_label.values(replace(drive, numbers=calibration))
            values = values[drive.ticks % stride == 0]
            parts.append(values[np.isfinite(values).all(axis=1)])
            names.extend([name] * len(parts[-1]))
    if not names:
        raise DataError(
            f"no row of {cohort.predicate.text!r} has all of {', '.join(with_label.names)}."
        )
    order = np.argsort(np.array(names), kind="stable")
    sample = np.concatenate(parts)[order]
    trip = np.array([trips[names[at]] for at in order])
    return RowSample(inputs.names, sample[:, :-1], sample[:, -1], trip)
