"""An evaluation from end to end, and the JSON document that keeps it, `evaluations/1.json`."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.evaluation.blind import sweep_gps_noise
from fleet_slip.evaluation.drives import EvaluatedDrive, find_stretches, rear_compliance
from fleet_slip.evaluation.filters import (
    Estimate,
    FilterEstimate,
    TrainedModels,
    TuningDrives,
    filter_bank,
    train_models,
)
from fleet_slip.evaluation.own_car import NAME as IDENTIFIED
from fleet_slip.evaluation.own_car import identified_estimate
from fleet_slip.evaluation.scenarios import (
    EvaluatedScenario,
    check_filter_targets,
    check_targets,
    run_all,
)
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.simulation.scenario import Failure, Scenario, load_scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS
from fleet_slip.storage.documents import Document, DocumentFolder, checksum
from fleet_slip.warehouse.tables import Warehouse

# Who wins a test drive, and whether a fleet-trained model beats the one-car model there.

LEAST_COVERAGE = 0.99
"""Share of a drive's rows that a competitor must have estimates for: who skips rows cannot win."""

CLOSE = 1.25
"""Ratio to the winner's RMSE up to which a lost drive counts as close."""


@dataclass(frozen=True)
class Standing:
    """How one estimator stands on one test drive against the others.

    Attributes:
        scenario: name of the test drive.
        winner, winner_rmse_deg: who has the smallest RMSE; None where nobody competes.
        rmse_deg: of the one estimator; None where it has too few estimates to compete.
        best_other, best_other_rmse_deg: the best of the others.
        same_as: an earlier test drive that differs from this one in satellite navigation alone, so
            that nobody who competes tells them apart.
    """

    scenario: str
    winner: str | None
    winner_rmse_deg: float | None
    rmse_deg: float | None
    best_other: str | None
    best_other_rmse_deg: float | None
    same_as: str | None = None

    @property
    def won(self) -> bool:
        """Whether the one estimator wins the drive."""
        return self.winner is not None and self.winner != self.best_other

    @property
    def ratio(self) -> float | None:
        """RMSE over that of the winner: 1 where it wins."""
        if self.rmse_deg is None or not self.winner_rmse_deg:
            return None
        return self.rmse_deg / self.winner_rmse_deg


@dataclass(frozen=True)
class Ranking:
    """How one estimator stands on all test drives; those that are the same count once."""

    estimator: str
    standings: tuple[Standing, ...]

    @property
    def counted(self) -> tuple[Standing, ...]:
        """The standings on drives that are not the same as one before."""
        return tuple(one for one in self.standings if one.same_as is None)

    @property
    def won(self) -> int:
        """Number of drives that it wins."""
        return sum(one.won for one in self.counted)

    @property
    def close(self) -> int:
        """Number of drives that it loses with at most `CLOSE` times the winner's RMSE."""
        return sum(
            one.ratio is not None and one.ratio <= CLOSE and not one.won for one in self.counted
        )

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "estimator": self.estimator,
            "least_coverage": LEAST_COVERAGE,
            "close_ratio": CLOSE,
            "drives": len(self.counted),
            "won": self.won,
            "close": self.close,
            "standings": [
                {**asdict(one), "won": one.won, "ratio": one.ratio} for one in self.standings
            ],
        }


def rank(runs: Sequence[EvaluatedScenario], estimator: str, gps: Collection[str]) -> Ranking:
    """Rank an estimator on every drive against all that use no GPS; it wins a tie."""
    return Ranking(
        estimator,
        tuple(
            replace(_stand(run, estimator, gps), same_as=_same_as(run.scenario, runs[:number]))
            for number, run in enumerate(runs)
        ),
    )


def _stand(run: EvaluatedScenario, estimator: str, gps: Collection[str]) -> Standing:
    errors = {
        name: result.whole.rmse_deg
        for name, result in run.results.items()
        if name not in gps
        and result.whole.rmse_deg is not None
        and result.whole.coverage >= LEAST_COVERAGE
    }
    ours = errors.pop(estimator, None)
    other = min(errors, key=lambda name: errors[name], default=None)
    others = None if other is None else errors[other]
    winner, least = other, others
    if ours is not None and (others is None or ours <= others):
        winner, least = estimator, ours
    return Standing(run.scenario.name, winner, least, ours, other, others)


def _same_as(scenario: Scenario, runs: Sequence[EvaluatedScenario]) -> str | None:
    """Return the first of some drives that is the same for whoever does not see GPS."""
    seen = _without_gps(scenario)
    return next((r.scenario.name for r in runs if _without_gps(r.scenario) == seen), None)


def _without_gps(scenario: Scenario) -> tuple[str, tuple[Failure, ...]]:
    """Return what of a scenario matters to who does not see GPS."""
    sensors = scenario.sensors.model_copy(update={"gps": load_scenario("nominal").sensors.gps})
    drive = scenario.model_copy(update={"drive": "any", "sensors": sensors}).batch()
    failures = tuple(f for f in scenario.failures if not set(f.signals) <= set(GPS_SIGNALS))
    return drive.digest, failures


def compare_fleets(
    runs: Sequence[EvaluatedScenario], one_car: TrainedModels, fleet: TrainedModels
) -> Iterator[dict[str, Any]]:
    """Compare the models of Table I that both cohorts can serve, wherever both have estimates."""
    for run in runs:
        for number, one in one_car.table_one.items():
            other = fleet.table_one.get(number)
            if other is None:
                continue
            ours, theirs = (run.results[name].whole.rmse_deg for name in (one, other))
            if ours is not None and theirs is not None:
                yield {
                    "scenario": run.scenario.name,
                    "model": number,
                    "one_car": one,
                    "fleet": other,
                    "one_car_rmse_deg": ours,
                    "fleet_rmse_deg": theirs,
                    "better": one if ours <= theirs else other,
                }


def _run(one: EvaluatedScenario) -> dict[str, Any]:
    scenario, drive = one.scenario, one.drive
    return {
        "name": scenario.name,
        "description": scenario.description,
        "paper": scenario.paper,
        "drive_id": scenario.drive_id,
        "vehicle_model": scenario.vehicle.name,
        "sprung_mass_kg": scenario.car.body.sprung_mass_kg,
        "adhesion": scenario.adhesion,
        "track": scenario.track.name,
        "failures": [failure.model_dump() for failure in scenario.failures],
        "truth": _truth(drive),
        "sections": [
            {
                "name": section.name,
                "criterion": section.criterion,
                "rows": int(section.rows.sum()),
                "stretches": [asdict(one) for one in find_stretches(drive, section.rows)],
            }
            for section in one.sections
        ],
        "results": {
            name: {
                **asdict(result.whole),
                "inside": {part: asdict(figures) for part, figures in result.inside.items()},
                "outside": {part: asdict(figures) for part, figures in result.outside.items()},
            }
            for name, result in one.results.items()
        },
    }


def _truth(drive: EvaluatedDrive) -> dict[str, Any]:
    sideslip_deg = np.degrees(drive.sideslip_rad[drive.evaluated])
    ay = drive.signals["ay_mps2"] - drive.scenario.sensors.ay_bias_mps2
    return {
        "rows": len(drive.time_s),
        "duration_s": len(drive.time_s) / 100,
        "lost_control_s": drive.lost_control_s,
        "sideslip_std_deg": float(sideslip_deg.std()),
        "sideslip_max_deg": float(np.abs(sideslip_deg).max()),
        "speed_min_mps": float(drive.speed_mps.min()),
        "speed_max_mps": float(drive.speed_mps.max()),
        "lateral_offset_max_m": float(np.abs(drive.lateral_offset_m).max()),
        "lateral_acceleration_p99_mps2": float(np.nanquantile(np.abs(ay), 0.99)),
        "rear_slip_per_lateral_acceleration_deg_s2pm": float(np.degrees(rear_compliance(drive))),
    }


def evaluations_of(warehouse: Warehouse) -> DocumentFolder:
    """Return where a data root keeps its evaluations."""
    return DocumentFolder(warehouse.root / "evaluations")


def keep(documents: DocumentFolder, content: Mapping[str, Any]) -> Document:
    """Add an evaluation, unless the latest one is the same; return its document."""

    def attempt(newest: int) -> Document | None:
        if newest and (before := documents.read(newest)).sha256 == checksum(content):
            return before
        return documents.create(newest + 1, content)

    return documents.after_newest(attempt)


@dataclass(frozen=True)
class Competitors:
    """All estimators that compete, by name, and what a document says of each."""

    one_car: TrainedModels
    fleets: tuple[TrainedModels, ...]
    estimators: Mapping[str, Estimate]
    descriptions: Mapping[str, Mapping[str, Any]]


def train_competitors(
    warehouse: Warehouse,
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> Competitors:
    """Fit and tune all that compete; filters get the one-car model's drives."""
    first, *others = (train_models(warehouse, version) for version in (one_car, *fleets))
    estimators: dict[str, Estimate] = {}
    descriptions: dict[str, Mapping[str, Any]] = {}
    for trained in (first, *others):
        estimators |= trained.estimators()
        descriptions |= trained.descriptions()
    weighed = "mass_kg" in Predictor.of(one_car.manifest).plan.facts
    drives = TuningDrives.of(warehouse, first.selection.cohort, weighed=weighed)
    bank, tuned_on = filter_bank(
        warehouse, drives, load_scenario("nominal").car, executor, weighed=weighed
    )
    identified = identified_estimate(warehouse, drives, executor)
    if identified is not None:
        estimators[IDENTIFIED] = identified
        descriptions[IDENTIFIED] = identified.description()
    filters = {name: {**one.description(), **tuned_on.get(name, {})} for name, one in bank.items()}
    return Competitors(first, tuple(others), estimators | bank, descriptions | filters)


def evaluate(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate a model and all that competes with it on scenarios that are in the logs.

    Returns the evaluation's document: of logs, models and program alone.
    """
    competitors = train_competitors(warehouse, one_car, fleets, executor)
    estimators, about = competitors.estimators, competitors.descriptions
    runs = run_all(warehouse, scenarios, estimators)
    first = competitors.one_car
    gps = {name for name, one in about.items() if one.get("gps")}
    filters = {
        name: one
        for name, one in estimators.items()
        if name in gps and isinstance(one, FilterEstimate)
    }
    sweep = sweep_gps_noise(runs, filters, list(first.estimators()))
    checks = (
        *check_targets(runs, first.table_one, first.linear_estimators()),
        *check_filter_targets(runs, first.table_one),
    )
    comparisons = [row for one in competitors.fleets for row in compare_fleets(runs, first, one)]
    cohort = first.selection.cohort
    return {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "estimators": {name: dict(one) for name, one in about.items()},
        "scenarios": [_run(one) for one in runs],
        "logs_version": cohort.logs_version,
        "grams_version": cohort.grams_version,
        "checks": [asdict(check) for check in checks],
        "comparisons": comparisons,
        "ranking": rank(runs, first.version.reference, gps).as_dict(),
        "gps_noise": sweep.as_dict() if sweep else None,
    }
