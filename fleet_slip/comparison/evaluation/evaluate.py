"""An evaluation from end to end, and the JSON document that keeps it, `evaluations/1.json`."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.comparison.evaluation.estimators import Estimate, TrainedModels, train_models
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.filters import FilterEstimate, filter_bank
from fleet_slip.comparison.evaluation.gps_noise import GpsSweep, sweep_gps_noise
from fleet_slip.comparison.evaluation.identified import NAME as IDENTIFIED
from fleet_slip.comparison.evaluation.identified import identified_estimate
from fleet_slip.comparison.evaluation.ranking import FleetComparison, Ranking, compare_fleets, rank
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario, run_all
from fleet_slip.comparison.evaluation.targets import (
    TargetCheck,
    check_filter_targets,
    check_targets,
)
from fleet_slip.comparison.evaluation.unstable import find_stretches, rear_compliance
from fleet_slip.files.documents import Document, DocumentFolder, checksum
from fleet_slip.models.estimates.predictor import Predictor
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.warehouse.tables import Warehouse

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
