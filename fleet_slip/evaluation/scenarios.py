"""Test drives, simulated where missing; every estimator on each; and the figures of its error."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import Progress, no_progress
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.drives import (
    CRITERION,
    EvaluatedDrive,
    find_stretches,
    find_unstable,
    load_drives,
    rear_compliance,
)
from fleet_slip.evaluation.filters import Estimate, LinearEstimate
from fleet_slip.grams.job import update_grams
from fleet_slip.simulation.job import SimulationReport, simulate_batches
from fleet_slip.simulation.scenario import Scenario
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ, Sensors
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
    constant = np.ptp(estimate) == 0 or np.ptp(truth) == 0
    correlation = None if constant else float(np.corrcoef(estimate, truth)[0, 1])
    median, p95, p99 = np.quantile(size, [0.5, 0.95, 0.99]).tolist()
    return ErrorFigures(
        rows=rows,
        coverage=len(truth) / rows,
        correlation=correlation,
        error_mean_deg=float(error.mean()),
        error_std_deg=float(error.std(ddof=1)),
        rmse_deg=float(np.sqrt(np.mean(error**2))),
        error_median_deg=median,
        error_p95_deg=p95,
        error_p99_deg=p99,
        error_max_deg=float(size.max()),
    )


def judge_together(
    estimates: Mapping[str, Sequence[FloatArray]],
    truths: Sequence[FloatArray],
    among: Sequence[BoolArray],
) -> dict[str, ErrorFigures]:
    """Return each estimator's figures over the rows of several drives together."""
    truth, rows = np.concatenate(truths), np.concatenate(among)
    return {
        name: error_figures(np.concatenate(found), truth, rows) for name, found in estimates.items()
    }


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


# What the estimators must reach on the paper's scenarios, checked; a miss is explained.
#
# Table II and the sentences of sections III.A to III.D, put into numbers.

PAPER_TABLE_TWO = {
    "1": (0.0135, 0.3018),
    "2": (-0.0146, 0.1754),
    "3": (-0.0209, 0.1556),
    "4": (-0.0060, 0.1549),
    "5": (-0.0079, 0.1505),
}
"""Mean and standard deviation of the error in deg on the paper's nominal drive, Table II."""

NOISE = "noise_doubled"


class Reached(NamedTuple):
    """Figures that requirements are about; NaN without estimates, which reaches nothing."""

    mean: float
    std: float
    correlation: float


def _reached(figures: ErrorFigures) -> Reached:
    found = (figures.error_mean_deg, figures.error_std_deg, figures.correlation)
    return Reached(*(math.nan if figure is None else figure for figure in found))


class Requirement(NamedTuple):
    """A limit on a figure of a scenario, which may be compared with that of the nominal drive.

    `found` takes the figures of the nominal drive and those of the scenario outside of unstable
    sections. The limit is a largest value, or the `least` one; None is the model's std of Table II.
    """

    text: str
    scenario: str
    found: Callable[[Reached, Reached], float]
    limit: float | None
    least: bool = False


REQUIREMENTS = (
    Requirement(
        "nominal: error std at most Table II's, deg", "nominal", lambda _, here: here.std, None
    ),
    Requirement(
        "nominal: size of the mean error at most 0.02, deg",
        "nominal", lambda _, here: abs(here.mean), 0.02,
    ),
    Requirement(
        "noise doubled: error std grows by at most 0.1, deg",
        NOISE, lambda nominal, here: here.std - nominal.std, 0.1,
    ),
    Requirement(
        "mass_1000: error std within 0.1 of nominal, deg",
        "mass_1000", lambda nominal, here: abs(here.std - nominal.std), 0.1,
    ),
    Requirement(
        "mass_1740: error std within 0.1 of nominal, deg",
        "mass_1740", lambda nominal, here: abs(here.std - nominal.std), 0.1,
    ),
    Requirement(
        "adhesion 0.7: correlation at least 0.95",
        "adhesion_0_7", lambda _, here: here.correlation, 0.95, least=True,
    ),
    Requirement(
        "adhesion 0.4: correlation at least 0.9 while stable",
        "adhesion_0_4", lambda _, here: here.correlation, 0.9, least=True,
    ),
    Requirement(
        "Melbourne: correlation lower than nominal by at most 0.05",
        "melbourne", lambda nominal, here: nominal.correlation - here.correlation, 0.05,
    ),
)  # fmt: skip
"""What is asked of each model of Table I."""


@dataclass(frozen=True)
class TargetCheck:
    """A requirement on an estimator; None without estimates, a miss has an `explanation`."""

    requirement: str
    scenario: str
    estimator: str
    found: float | None
    limit: float | None
    reached: bool
    explanation: str = ""


def _target(
    text: str, scenario: str, name: str, found: float, limit: float, reached: bool, why: str
) -> TargetCheck:
    kept, most = (one if math.isfinite(one) else None for one in (found, limit))
    return TargetCheck(text, scenario, name, kept, most, reached, "" if reached else why)


def check_targets(
    runs: Sequence[EvaluatedScenario],
    models: Mapping[str, str],
    estimators: Mapping[str, LinearEstimate],
) -> Iterator[TargetCheck]:
    """Check each model of Table I, named by its estimator, on the scenarios that were run."""
    by_name = {run.scenario.name: run for run in runs}
    nominal = by_name.get("nominal")
    for one in REQUIREMENTS:
        run = by_name.get(one.scenario)
        if nominal is None or run is None:
            continue
        for number, name in models.items():
            here = run.results[name]
            outside = here.outside.get("unstable", here.whole)
            found = one.found(_reached(nominal.results[name].whole), _reached(outside))
            limit = PAPER_TABLE_TWO[number][1] if one.limit is None else one.limit
            reached = found >= limit if one.least else found <= limit
            noisy = one.scenario == NOISE
            why = _noise(estimators[name], nominal, run) if noisy else _compliance(run, nominal)
            yield _target(one.text, one.scenario, name, found, limit, reached, why)


FILTER_SCENARIOS = ("nominal", "gps_clear", "gps_urban", "gps_tunnel")
THE_PAPERS_CHOICE = "4"
"""The model of Table I that the paper compares with the Kalman filter."""


def check_filter_targets(
    runs: Sequence[EvaluatedScenario], models: Mapping[str, str]
) -> Iterator[TargetCheck]:
    """Check that the regression beats the paper's Kalman filter, as it is and tuned."""
    name = models.get(THE_PAPERS_CHOICE)
    for run in runs:
        scenario = run.scenario.name
        for rival in ("kalman", "kalman_tuned"):
            if name is None or scenario not in FILTER_SCENARIOS or rival not in run.results:
                continue
            ours, theirs = run.results[name], run.results[rival]
            parts = [("error std", ours.whole, theirs.whole, _CORRECTED)]
            if "gps_outage" in ours.inside:
                inside, outside = ours.inside["gps_outage"], theirs.inside["gps_outage"]
                parts.append(("error std in outages", inside, outside, _drift(run)))
            for figure, our, their, why in parts:
                found, limit = _reached(our).std, _reached(their).std
                text = f"{scenario}: {figure} below that of {rival}, deg"
                yield _target(text, scenario, name, found, limit, found < limit, why)


_CORRECTED = (
    "The filter is corrected by the true velocity with every fix of satellite navigation, which "
    "the regression does without; while fixes come, its error is what their noise allows."
)


def _drift(run: EvaluatedScenario) -> str:
    (section,) = (part for part in run.sections if part.name == "gps_outage")
    longest_s = max(s.until_s - s.from_s for s in find_stretches(run.drive, section.rows))
    return (
        f"The longest outage of this drive lasts {longest_s + GPS_OUTAGE_S:.0f} s. With biases "
        "known from before, the integrated accelerations drift no further in that time than the "
        "regression is off."
    )


def passed_noise_deg(model: LinearEstimate, sensors: Sensors) -> float:
    """Return the std that white noise gives the estimate: sqrt(sum (coefficient * std)²)."""
    stds = {catalogue()[name].column: std for name, (_, std) in sensors.bias_and_std.items()}
    squares = [(weight * stds[column]) ** 2 for column, weight in model.coefficients.items()]
    return math.degrees(math.sqrt(math.fsum(squares)))


def _noise(model: LinearEstimate, nominal: EvaluatedScenario, noisy: EvaluatedScenario) -> str:
    before = passed_noise_deg(model, nominal.scenario.sensors)
    after = passed_noise_deg(model, noisy.scenario.sensors)
    return (
        "White noise of its signals alone reaches the estimate with a standard deviation of "
        f"{before:.3f} deg at the initial noise and {after:.3f} deg here, the root of the sum of "
        "(coefficient * standard deviation) squared. The fewer signals a model has, the larger "
        "the coefficients that it puts on the noisy ones."
    )


def _compliance(run: EvaluatedScenario, nominal: EvaluatedScenario) -> str:
    here = math.degrees(rear_compliance(run.drive))
    there = math.degrees(rear_compliance(nominal.drive))
    return (
        f"The rear axle slips by {here:.3f} deg per m/s² of lateral acceleration here and by "
        f"{there:.3f} in the nominal drive. Side-slip is b r / vx less that slip, and no signal of "
        "the model tells how much load, tyres and road have changed it."
    )
