"""Evaluates a published model on the rows of a cohort."""

import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import pluralize
from fleet_slip.calibration.car_calibration import calibrate
from fleet_slip.catalog.signals import MEASURED, RECEIVED, SAMPLE_TIME_S, SignalCatalog
from fleet_slip.errors import DataError
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import hash_names
from fleet_slip.grams.compute import counts_of, drives_of_stream
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import Registry
from fleet_slip.models.summary import remark_skipped_rows
from fleet_slip.quality.drive_signals import SPEEDS, is_slow
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.database import (
    Predicate,
    drive_columns,
    guarded_query,
    parse_cohort,
    row_columns,
    sql_text,
)
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.warehouse import Warehouse

BATCH_ROWS = 2**17


@dataclass(frozen=True)
class Score(Answer):
    """Figures of the error, estimate minus truth, over the rows of a cohort with the signals."""

    DOCUMENT = (
        "model cohort rows correlation rmse_deg error_mean_deg error_std_deg "
        "error_mean_absolute_deg error_median_deg error_p95_deg error_p99_deg error_max_deg drives "
        "drives_trained drives_left_out rows_without examined"
    )

    rows: int
    correlation: float | None
    rmse_deg: float
    error_mean_deg: float
    error_std_deg: float
    error_mean_absolute_deg: float
    error_median_deg: float
    error_p95_deg: float
    error_p99_deg: float
    error_max_deg: float
    drives: int = 0
    """Drives of the cohort; the model was trained on `drives_trained` of them."""
    drives_trained: int = 0
    drives_left_out: int = 0
    """Training drives that are not scored, since no cohort is named."""
    rows_without: int = 0
    """Rows of the cohort without the label or a signal of the model."""
    examined: str = ""
    """Drives that are left out for faulty sensors, as a sentence."""
    model: str = ""
    cohort: str = ""
    measured_cohort: str = ""
    """Cohort for `evaluate`, if the training drives are measured."""

    def parts(self) -> Iterator[Part]:
        """Return the figures, and the drives and rows that are left out."""
        if self.examined:
            yield Remark(self.examined)
        yield TextTable(
            f"{self.model} on {pluralize(self.rows, 'row')}",
            f"figure|{self.model}",
            (
                [name.replace("_deg", ", deg").replace("_", " "), f"{value:.4f}"]
                for name, value in vars(self).items()
                if name.startswith(("error", "rmse", "correlation")) and value is not None
            ),
        )
        yield from remark_skipped_rows(self.rows_without, self.rows + self.rows_without)
        if self.drives_left_out:
            count = pluralize(self.drives_left_out, "drive")
            yield Remark(f"left out: {count} of {self.drives:,} that {self.model} was trained on.")
        elif self.drives_trained:
            measured = self.measured_cohort
            options = f" --cohort {shlex.quote(measured)}" if measured else ""
            yield Remark(
                f"{self.model} was trained on {self.drives_trained:,} of these "
                f"{pluralize(self.drives, 'drive')}: its error there is a training error. On "
                f"held-out drives: fleet-slip evaluate {self.model}{options}"
            )


def score(warehouse: Warehouse, manifest: Manifest, predicate: str | Predicate) -> Score:
    """Score a model on the rows of `log` that satisfy a predicate.

    The drives that have such rows are estimated whole. Raises `QuestionError` for a predicate that
    is not one expression, and `DataError` if no row has the model's signals.
    """
    predicate = cohort_of_rows(warehouse.catalog.signals, predicate)
    estimate_rad, truth_rad, rows = _estimate_rows(warehouse, manifest, predicate)
    if not len(truth_rad):
        raise DataError(
            f"no row of the cohort {predicate.quoted} has {', '.join(manifest.signals)} and "
            f"{manifest.label.signal}. Choose another cohort, or a model with fewer signals."
        )
    return _figures(estimate_rad, truth_rad, rows)


def cohort_of_rows(signals: SignalCatalog, predicate: str | Predicate) -> Predicate:
    """Return the predicate of a cohort of rows, on the view `log`. Raises `QuestionError`."""
    if isinstance(predicate, Predicate):
        return predicate
    return parse_cohort(signals, predicate, row_columns(signals))


def _estimate_rows(
    warehouse: Warehouse, manifest: Manifest, predicate: Predicate
) -> tuple[FloatArray, FloatArray, int]:
    """Return estimate and label in rad of the rows that have both, and the number of all rows.

    Rows in which the car `is_slow` do not count.
    """
    signals = warehouse.catalog.signals
    predictor = Predictor.from_manifest(signals, manifest)
    label = manifest.label.signal
    speeds = [name for name in SPEEDS if name in signals.signals]
    needed = [*predictor.plan.signals, label, *speeds, *predictor.plan.facts, "vehicle_id"]
    cars = calibrated_cars(warehouse) if predictor.plan.numbers else {}
    counts = ", ".join(dict.fromkeys(needed))
    # The rows of `log_counts` with the columns of the view `log`.
    values = [f"{name} * {s.scale}::DOUBLE AS {s.column}" for name, s in signals.signals.items()]
    time = f"tick / {int(1 / SAMPLE_TIME_S)}::DOUBLE AS time_s"
    text = read_sql("jobs", "drives_in_time.sql").format(
        columns=counts,
        rows=f"(SELECT *, {', '.join([time, *values])} FROM log_counts)",
        predicate=predicate.sql,
    )
    estimates: list[FloatArray] = []
    truths: list[FloatArray] = []
    total = 0
    with (
        connect_tables(warehouse, text) as database,
        guarded_query(database, predicate),
    ):
        stream = database.sql(text).to_arrow_reader(BATCH_ROWS)
        for rows in drives_of_stream(stream):
            numbers = cars.get(rows["vehicle_id"][0].as_py())
            estimate = predictor(counts_of(rows, predictor.plan, None, numbers))
            truth, slow = label_of(signals, rows)
            chosen = rows["chosen"].to_numpy(zero_copy_only=False).astype(np.bool_) & ~slow
            total += int(chosen.sum())
            complete = chosen & np.isfinite(estimate) & np.isfinite(truth)
            estimates.append(estimate[complete])
            truths.append(truth[complete])
    estimate_rad, truth_rad = (
        np.concatenate([*parts, np.empty(0)]) for parts in (estimates, truths)
    )
    return estimate_rad, truth_rad, total


def label_of(signals: SignalCatalog, rows: pa.Table) -> tuple[FloatArray, BoolArray]:
    """Return the label of rows in rad, NaN where null, and the rows where the car `is_slow`."""
    names = [name for name in SPEEDS if name in signals.signals and name in rows.column_names]
    slow = is_slow({name: _physical(signals, rows, name) for name in names})
    return _physical(signals, rows, signals.label), np.broadcast_to(slow, len(rows))


def _physical(signals: SignalCatalog, rows: pa.Table, name: str) -> FloatArray:
    """Return a column of counts in SI units, NaN where null."""
    counts = rows[name].to_numpy(zero_copy_only=False)
    return np.asarray(counts.astype(np.float64) * float(signals[name].scale))


def calibrated_cars(warehouse: Warehouse) -> CarCounts:
    """Return the counts of the calibration parameters of every car. Raises `DataError`."""
    return calibrate(warehouse).counts()


def _figures(estimate_rad: FloatArray, truth_rad: FloatArray, rows: int) -> Score:
    error = np.degrees(estimate_rad - truth_rad)
    size = np.abs(error)
    several = len(error) > 1
    constant = not np.ptp(estimate_rad) or not np.ptp(truth_rad)
    median, p95, p99 = np.quantile(size, [0.5, 0.95, 0.99]).tolist()
    return Score(
        rows=len(error),
        correlation=None if constant else float(np.corrcoef(estimate_rad, truth_rad)[0, 1]),
        rmse_deg=float(np.sqrt(np.mean(error**2))),
        error_mean_deg=float(error.mean()),
        error_std_deg=float(error.std(ddof=1)) if several else math.nan,
        error_mean_absolute_deg=float(size.mean()),
        error_median_deg=median,
        error_p95_deg=p95,
        error_p99_deg=p99,
        error_max_deg=float(size.max()),
        rows_without=rows - len(error),
    )


# Drives of a cohort that are in the training set of a version, and the others.


@dataclass(frozen=True)
class TrainingOverlap:
    """Numbers of drives of a cohort and of training drives in it; predicate of the unseen ones.

    `measured` is true if a training drive is measured.
    """

    drives: int
    trained: int
    unseen: Predicate
    measured: bool


def find_training_overlap(
    warehouse: Warehouse, registry: Registry, manifest: Manifest, predicate: str | Predicate
) -> TrainingOverlap:
    """Find the training drives of a version in a cohort of rows with logs. Raises as `score`."""
    signals = warehouse.catalog.signals
    cohort = cohort_of_rows(signals, predicate)
    view = "log" if cohort.columns - set(drive_columns(signals)) else "drives"
    logged = f"({cohort.sql}) AND source <> '{RECEIVED}'"
    query = f"SELECT DISTINCT drive_id, source FROM {view} WHERE {logged} ORDER BY 1"
    with connect_tables(warehouse, query) as database, guarded_query(database, cohort):
        drives = database.sql(query).to_arrow_table()
    names = drives["drive_id"]
    is_trained = registry.trained_drives(manifest).among(hash_names(names))
    trained = int(is_trained.sum())
    measured = MEASURED in drives["source"].filter(pa.array(is_trained)).to_pylist()
    if trained in (0, len(names)):
        return TrainingOverlap(len(names), trained, cohort, measured)
    unseen = ", ".join(map(sql_text, names.filter(pa.array(~is_trained)).to_pylist()))
    predicate = Predicate(cohort.text, f"({cohort.sql} AND drive_id IN ({unseen}))")
    return TrainingOverlap(len(names), trained, predicate, measured)
