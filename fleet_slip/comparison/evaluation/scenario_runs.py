"""Test drives, simulated where missing; every estimator on each; and the figures of its error."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.comparison.evaluation.estimators import Estimate
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive, load_drives
from fleet_slip.comparison.evaluation.unstable import CRITERION, find_unstable
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.progress import Progress, no_progress
from fleet_slip.simulation.scenario import Scenario
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ
from fleet_slip.simulation.simulation_job import SimulationReport, simulate_batches
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class ErrorFigures:
    """How far estimates are off on some rows.

    Attributes:
        rows: number of rows that ask for an estimate.
        coverage: share of them with an estimate; all else is over these.
        correlation: of estimate and truth; None if one of them is constant or there are none.
        error_mean_deg, error_std_deg: as in Table II; None, like all that follows, without rows.
        rmse_deg: root mean square error.
        error_median_deg, error_p95_deg, error_p99_deg, error_max_deg: of the absolute error.
    """

    rows: int
    coverage: float
    correlation: float | None = None
    error_mean_deg: float | None = None
    error_std_deg: float | None = None
    rmse_deg: float | None = None
    error_median_deg: float | None = None
    error_p95_deg: float | None = None
    error_p99_deg: float | None = None
    error_max_deg: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for a JSON document."""
        return asdict(self)


def error_figures(
    estimate_rad: FloatArray, truth_rad: FloatArray, among: BoolArray
) -> ErrorFigures:
    """Return the figures over the rows of a mask, shape (rows,); what is not finite is none."""
    rows = int(among.sum())
    given = among & np.isfinite(estimate_rad)
    estimate, truth = estimate_rad[given], truth_rad[given]
    if len(truth) < 2:
        return ErrorFigures(rows, len(truth) / rows if rows else 0.0)
    error = np.degrees(estimate - truth)
    size = np.abs(error)
    median, p95, p99 = np.quantile(size, [0.5, 0.95, 0.99]).tolist()
    return ErrorFigures(
        rows=rows,
        coverage=len(truth) / rows,
        correlation=pearson_correlation(estimate, truth),
        error_mean_deg=float(error.mean()),
        error_std_deg=float(error.std(ddof=1)),
        rmse_deg=float(np.sqrt(np.mean(error**2))),
        error_median_deg=median,
        error_p95_deg=p95,
        error_p99_deg=p99,
        error_max_deg=float(size.max()),
    )


def pearson_correlation(first: FloatArray, second: FloatArray) -> float | None:
    """Return Pearson's correlation of two arrays of shape (rows,); None if one is constant."""
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(np.corrcoef(first, second)[0, 1])


GPS_OUTAGE_S = 1.0
"""Time without a fix after which satellite navigation counts as lost."""


@runtime_checkable
class InDrive(Protocol):
    """An estimator that is told something of the car, or of the road, before a drive."""

    def in_drive(self, drive: EvaluatedDrive) -> Estimate:
        """Return the estimator for a drive."""


@dataclass(frozen=True)
class Section:
    """A part of a drive on which errors are also taken by themselves; `rows` has shape (ticks,)."""

    name: str
    criterion: str
    rows: BoolArray


@dataclass(frozen=True)
class Result:
    """Figures of one estimator on one drive; inside and outside of each section by its name."""

    whole: ErrorFigures
    inside: Mapping[str, ErrorFigures]
    outside: Mapping[str, ErrorFigures]


@dataclass(frozen=True)
class EvaluatedScenario:
    """One scenario: the drive, its sections, and estimates and results by estimator."""

    drive: EvaluatedDrive
    sections: tuple[Section, ...]
    estimates: Mapping[str, FloatArray]
    results: Mapping[str, Result]

    @property
    def scenario(self) -> Scenario:
        """What the drive is a test of."""
        return self.drive.scenario


def simulate_scenarios(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    executor: Executor,
    progress: Progress = no_progress,
) -> SimulationReport:
    """Write drives that are missing, and update Gram rows. Raises `RefusedError` if changed."""
    batches = {scenario.drive_id: scenario.batch() for scenario in scenarios}
    report = simulate_batches(warehouse, list(batches.values()), executor, progress)
    if report.changed:
        update_grams(warehouse)
    return report


def run_all(
    warehouse: Warehouse, scenarios: Sequence[Scenario], estimators: Mapping[str, Estimate]
) -> tuple[EvaluatedScenario, ...]:
    """Evaluate estimators on scenarios whose drives are in the logs."""
    return tuple(evaluate_drive(drive, estimators) for drive in load_drives(warehouse, scenarios))


def evaluate_drive(drive: EvaluatedDrive, estimators: Mapping[str, Estimate]) -> EvaluatedScenario:
    """Evaluate estimators on one drive. An estimator sees its signals and nothing else."""
    parts = sections(drive)
    estimates = {name: _estimates(drive, estimate) for name, estimate in estimators.items()}
    results = {name: _result(drive, parts, rad) for name, rad in estimates.items()}
    return EvaluatedScenario(drive, parts, estimates, results)


def _estimates(drive: EvaluatedDrive, estimate: Estimate) -> FloatArray:
    """Return the estimates; none where the drive lacks what the estimator needs to begin."""
    try:
        if isinstance(estimate, InDrive):
            estimate = estimate.in_drive(drive)
        return estimate(drive.signals)
    except (DataError, QuestionError):
        return np.full(len(drive.time_s), np.nan)


def _result(drive: EvaluatedDrive, parts: Sequence[Section], estimate_rad: FloatArray) -> Result:
    def figures(among: BoolArray) -> ErrorFigures:
        return error_figures(estimate_rad, drive.sideslip_rad, among & drive.evaluated)

    return Result(
        whole=figures(np.ones(len(estimate_rad), dtype=np.bool_)),
        inside={part.name: figures(part.rows) for part in parts},
        outside={part.name: figures(~part.rows) for part in parts},
    )


def sections(drive: EvaluatedDrive) -> tuple[Section, ...]:
    """Return the sections of a drive that have any rows."""
    ticks = np.arange(len(drive.time_s))
    fixes = np.isfinite(drive.signals["gps_vx_mps"])
    latest = np.maximum.accumulate(np.where(fixes, ticks, 0))
    found = (
        Section("unstable", CRITERION, find_unstable(drive)),
        Section(
            "gps_outage",
            f"more than {GPS_OUTAGE_S:g} s since the last fix of satellite navigation",
            (ticks - latest) > GPS_OUTAGE_S * SAMPLE_RATE_HZ,
        ),
    )
    return tuple(section for section in found if section.rows.any())
