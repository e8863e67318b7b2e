"""Judges estimators on drives: how far each is off, where, and who wins."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.drives import CRITERION, EvaluatedDrive, find_unstable
from fleet_slip.simulation.scenario import Failure, Scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS, SAMPLE_RATE_HZ, Gps

Signals = Mapping[str, FloatArray]
"""One drive at 100 Hz: an array of shape (ticks,) for each SI column; NaN where null."""

Estimate = Callable[[Signals], FloatArray]
"""Side-slip angle in rad at every tick, shape (ticks,); NaN where there is no estimate."""


@runtime_checkable
class InDrive(Protocol):
    """An estimator that knows something of the car, or of the road, before a drive."""

    def in_drive(self, drive: EvaluatedDrive) -> Estimate:
        """Return the estimator for a drive."""


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


@dataclass(frozen=True)
class JudgedDrive:
    """One drive with the estimates of all who compete; arrays have shape (ticks,).

    Attributes:
        name: of the drive, or of its scenario.
        truth_rad: true angle, or the label.
        evaluated: rows that are judged.
        estimates: by estimator, in rad.
    """

    name: str
    truth_rad: FloatArray
    evaluated: BoolArray
    estimates: Mapping[str, FloatArray]

    @property
    def sideslip_std_deg(self) -> float:
        """How much the angle varies; 0 without rows."""
        truth = self.truth_rad[self.evaluated]
        return float(np.degrees(truth.std())) if len(truth) else 0.0


def judge(drives: Sequence[JudgedDrive]) -> dict[str, ErrorFigures]:
    """Return each estimator's figures over the rows of one drive, or of several together."""
    truth = np.concatenate([one.truth_rad for one in drives])
    rows = np.concatenate([one.evaluated for one in drives])
    return {
        name: error_figures(np.concatenate([one.estimates[name] for one in drives]), truth, rows)
        for name in drives[0].estimates
    }


def spread_over(drives: Sequence[JudgedDrive], name: str) -> dict[str, Any]:
    """Return the standard error of an estimator's RMSE over drives, and the drive it errs most on.

    The mean squared error is a quotient of sums over drives, Σ Sd / Σ nd, whose variance is that
    of Sd − MSE nd (Cochran, "Sampling Techniques" (1977), section 6.4). None of a single drive.
    """
    found = [(one.name, judge([one])[name]) for one in drives]
    kept = [(drive, one.rows * one.coverage, one.rmse_deg) for drive, one in found if one.rmse_deg]
    rows, rmse = np.array([n for _, n, _ in kept]), np.array([rmse for *_, rmse in kept])
    error = None
    if len(kept) > 1:
        mean_square = float(rows @ rmse**2 / rows.sum())
        rest = rows * (rmse**2 - mean_square)
        variance = len(kept) / (len(kept) - 1) * float(rest @ rest) / float(rows.sum()) ** 2
        error = math.sqrt(variance) / (2 * math.sqrt(mean_square))
    worst = max(kept, key=lambda one: one[2], default=None)
    return {
        "rmse_standard_error_deg": error,
        "worst_drive": worst and worst[0],
        "worst_drive_rmse_deg": worst and worst[2],
    }


GPS_OUTAGE_S = 1.0
"""Time without a fix after which satellite navigation counts as lost."""


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
class EvaluatedScenario(JudgedDrive):
    """The drive of a scenario, its sections, and results by estimator."""

    drive: EvaluatedDrive
    sections: tuple[Section, ...]
    results: Mapping[str, Result]

    @property
    def scenario(self) -> Scenario:
        """What the drive is a test of."""
        return self.drive.scenario


def evaluate_drive(drive: EvaluatedDrive, estimators: Mapping[str, Estimate]) -> EvaluatedScenario:
    """Evaluate estimators on one drive. An estimator sees its signals and nothing else."""
    parts = sections(drive)
    truth, evaluated = drive.sideslip_rad, drive.evaluated
    estimates = {name: _estimates(drive, estimate) for name, estimate in estimators.items()}
    results = {
        name: Result(
            error_figures(rad, truth, evaluated),
            {part.name: error_figures(rad, truth, part.rows & evaluated) for part in parts},
            {part.name: error_figures(rad, truth, ~part.rows & evaluated) for part in parts},
        )
        for name, rad in estimates.items()
    }
    return EvaluatedScenario(
        drive.scenario.name, truth, evaluated, estimates, drive, parts, results
    )


def _estimates(drive: EvaluatedDrive, estimate: Estimate) -> FloatArray:
    """Return the estimates; none where the drive lacks what the estimator needs to begin."""
    try:
        if isinstance(estimate, InDrive):
            estimate = estimate.in_drive(drive)
        return estimate(drive.signals)
    except (DataError, QuestionError):
        return np.full(len(drive.time_s), np.nan)


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


# Who wins a test drive.

LEAST_COVERAGE = 0.99
"""Share of a drive's rows that a competitor must have estimates for: who skips rows cannot win."""

CLOSE = 1.25
"""Ratio to the winner's RMSE up to which a lost drive counts as close."""


def rank(runs: Sequence[EvaluatedScenario], estimator: str, gps: Collection[str]) -> dict[str, Any]:
    """Rank an estimator on every drive against all that use no GPS; it wins a tie.

    Returns what a document says. Drives that differ in satellite navigation alone count once:
    `same_as` names the first.
    """
    standings = [
        {
            "scenario": run.name,
            **_stand(run, estimator, gps),
            "same_as": _same_as(run.scenario, runs[:number]),
        }
        for number, run in enumerate(runs)
    ]
    counted = [one for one in standings if one["same_as"] is None]
    lost = [one["ratio"] for one in counted if one["ratio"] is not None and not one["won"]]
    return {
        "estimator": estimator,
        "least_coverage": LEAST_COVERAGE,
        "close_ratio": CLOSE,
        "drives": len(counted),
        "won": sum(one["won"] for one in counted),
        "close": sum(ratio <= CLOSE for ratio in lost),
        "standings": standings,
    }


def _stand(run: EvaluatedScenario, estimator: str, gps: Collection[str]) -> dict[str, Any]:
    """Return who wins a drive, None where nobody competes, and how the one estimator stands."""
    whole = {name: result.whole for name, result in run.results.items() if name not in gps}
    errors = {
        name: one.rmse_deg
        for name, one in whole.items()
        if one.rmse_deg is not None and one.coverage >= LEAST_COVERAGE
    }
    ours = errors.get(estimator)
    winner = min(errors, key=lambda name: (errors[name], name != estimator), default=None)
    least = errors[winner] if winner else None
    return {
        "winner": winner,
        "winner_rmse_deg": least,
        "rmse_deg": ours,
        "won": winner == estimator,
        "ratio": ours / least if ours is not None and least else None,
    }


def _same_as(scenario: Scenario, runs: Sequence[EvaluatedScenario]) -> str | None:
    """Return the first of some drives that is the same for whoever does not see GPS."""
    gps = scenario.sensors.gps
    seen = _with_gps(gps, scenario)
    return next((run.name for run in runs if _with_gps(gps, run.scenario) == seen), None)


def _with_gps(gps: Gps, scenario: Scenario) -> tuple[str, tuple[Failure, ...]]:
    """Return what of a scenario matters to an estimator without GPS, all with the same GPS."""
    sensors = scenario.sensors.model_copy(update={"gps": gps})
    drive = scenario.model_copy(update={"drive": "any", "sensors": sensors}).batch()
    failures = tuple(f for f in scenario.failures if not set(f.signals) <= set(GPS_SIGNALS))
    return drive.digest, failures


def compare_models(
    runs: Sequence[EvaluatedScenario], one_car: Mapping[str, str], fleet: Mapping[str, str]
) -> Iterator[dict[str, Any]]:
    """Compare the models of Table I of two cohorts, by number, wherever both have estimates."""
    for run in runs:
        for number in (number for number in one_car if number in fleet):
            one, other = one_car[number], fleet[number]
            ours, theirs = (run.results[name].whole.rmse_deg for name in (one, other))
            if ours is not None and theirs is not None:
                yield {
                    "scenario": run.name,
                    "model": number,
                    "one_car": one,
                    "fleet": other,
                    "one_car_rmse_deg": ours,
                    "fleet_rmse_deg": theirs,
                    "better": one if ours <= theirs else other,
                }
