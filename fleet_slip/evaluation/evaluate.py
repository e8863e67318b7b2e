"""An evaluation from end to end, and the JSON document that keeps it, `evaluations/1.json`."""

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.evaluation.blind import GpsSweep, sweep_gps_noise
from fleet_slip.evaluation.drives import EvaluatedDrive, find_stretches, rear_compliance
from fleet_slip.evaluation.filters import (
    Estimate,
    FilterEstimate,
    TrainedModels,
    filter_bank,
    train_models,
)
from fleet_slip.evaluation.own_car import NAME as IDENTIFIED
from fleet_slip.evaluation.own_car import identified_estimate
from fleet_slip.evaluation.scenarios import (
    EvaluatedScenario,
    TargetCheck,
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


@dataclass(frozen=True)
class FleetComparison:
    """RMSE of the same set of signals, trained on one car and on a fleet, on one scenario."""

    scenario: str
    model: str
    one_car: str
    fleet: str
    one_car_rmse_deg: float
    fleet_rmse_deg: float

    @property
    def better(self) -> str:
        """Which estimator has the smaller error."""
        return self.one_car if self.one_car_rmse_deg <= self.fleet_rmse_deg else self.fleet

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {**asdict(self), "better": self.better}


def compare_fleets(
    runs: Sequence[EvaluatedScenario], one_car: TrainedModels, fleet: TrainedModels
) -> tuple[FleetComparison, ...]:
    """Compare the models of Table I that both cohorts can serve, wherever both have estimates."""
    found = []
    for run in runs:
        for number, one in one_car.table_one.items():
            other = fleet.table_one.get(number)
            if other is None:
                continue
            errors = [run.results[name].whole.rmse_deg for name in (one, other)]
            if errors[0] is not None and errors[1] is not None:
                found.append(
                    FleetComparison(run.scenario.name, number, one, other, errors[0], errors[1])
                )
    return tuple(found)


FORMAT = 1


def document(
    runs: Sequence[EvaluatedScenario], estimators: Mapping[str, Mapping[str, Any]], **further: Any
) -> dict[str, Any]:
    """Return an evaluation's document: of logs, models and program alone, `further` keys beside."""
    return {
        "format": FORMAT,
        "package_version": package_version("fleet-slip"),
        "estimators": {name: dict(about) for name, about in estimators.items()},
        "scenarios": [_run(one) for one in runs],
        **further,
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
                **result.whole.as_dict(),
                "inside": {part: figures.as_dict() for part, figures in result.inside.items()},
                "outside": {part: figures.as_dict() for part, figures in result.outside.items()},
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

    @property
    def using_gps(self) -> frozenset[str]:
        """Names of the estimators that need satellite navigation."""
        return frozenset(name for name, one in self.descriptions.items() if one.get("gps"))

    @property
    def gps_filters(self) -> dict[str, FilterEstimate]:
        """The filters that need satellite navigation, by name."""
        filters = {n: one for n, one in self.estimators.items() if isinstance(one, FilterEstimate)}
        return {name: one for name, one in filters.items() if one.filter.gps}


@dataclass(frozen=True)
class Evaluation:
    """Everything that an evaluation found, with the drives and estimates behind it."""

    competitors: Competitors
    runs: tuple[EvaluatedScenario, ...]
    checks: tuple[TargetCheck, ...]
    comparisons: tuple[FleetComparison, ...]
    ranking: Ranking
    gps_noise: GpsSweep | None

    def as_dict(self) -> dict[str, Any]:
        """Return the evaluation's document."""
        cohort = self.competitors.one_car.selection.cohort
        return document(
            self.runs,
            self.competitors.descriptions,
            logs_version=cohort.logs_version,
            grams_version=cohort.grams_version,
            checks=[check.as_dict() for check in self.checks],
            comparisons=[comparison.as_dict() for comparison in self.comparisons],
            ranking=self.ranking.as_dict(),
            gps_noise=self.gps_noise.as_dict() if self.gps_noise else None,
        )


def train_competitors(
    warehouse: Warehouse,
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> Competitors:
    """Fit and tune all that compete; filters get the one-car model's drives."""
    first = train_models(warehouse, one_car)
    others = tuple(train_models(warehouse, version) for version in fleets)
    estimators: dict[str, Estimate] = {}
    descriptions: dict[str, Mapping[str, Any]] = {}
    for trained in (first, *others):
        estimators |= trained.estimators()
        descriptions |= trained.descriptions()
    cohort = first.selection.cohort
    weighed = "mass_kg" in Predictor.of(one_car.manifest).plan.facts
    nominal = load_scenario("nominal").car
    bank = filter_bank(warehouse, cohort, nominal, executor, weighed=weighed)
    identified = identified_estimate(warehouse, bank.drives, executor)
    if identified is not None:
        estimators[IDENTIFIED] = identified
        descriptions[IDENTIFIED] = identified.description()
    return Competitors(
        one_car=first,
        fleets=others,
        estimators=estimators | bank.estimators,
        descriptions=descriptions | bank.descriptions,
    )


def evaluate(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> Evaluation:
    """Evaluate a model and all that competes with it on scenarios that are in the logs."""
    competitors = train_competitors(warehouse, one_car, fleets, executor)
    runs = run_all(warehouse, scenarios, competitors.estimators)
    first = competitors.one_car
    return Evaluation(
        competitors=competitors,
        runs=runs,
        checks=(
            *check_targets(runs, first.table_one, first.linear_estimators()),
            *check_filter_targets(runs, first.table_one),
        ),
        comparisons=tuple(
            row for fleet in competitors.fleets for row in compare_fleets(runs, first, fleet)
        ),
        ranking=rank(runs, first.version.reference, competitors.using_gps),
        gps_noise=sweep_gps_noise(runs, competitors.gps_filters, list(first.estimators())),
    )
