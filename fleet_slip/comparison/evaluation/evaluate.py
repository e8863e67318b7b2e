"""An evaluation from end to end, and the JSON document that keeps it, `evaluations/1.json`."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.comparison.evaluation.estimators import Estimate, TrainedModels, train_models
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.filters import Bank, FilterEstimate, filter_bank
from fleet_slip.comparison.evaluation.gps_noise import GpsSweep, sweep_gps_noise
from fleet_slip.comparison.evaluation.identified import NAME as IDENTIFIED
from fleet_slip.comparison.evaluation.identified import identified_estimate
from fleet_slip.comparison.evaluation.ranking import FleetComparison, Ranking, compare_fleets, rank
from fleet_slip.comparison.evaluation.scenario_runs import ErrorFigures, EvaluatedScenario, run_all
from fleet_slip.comparison.evaluation.targets import (
    TargetCheck,
    check_filter_targets,
    check_targets,
)
from fleet_slip.comparison.evaluation.unstable import find_stretches, rear_compliance
from fleet_slip.files.documents import Document, DocumentFolder, checksum
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.models.estimates.predictor import Predictor
from fleet_slip.models.manifest import Manifest
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
class Rival:
    """A rival that was trained, with what it reaches and costs.

    Attributes:
        name: among the estimators.
        learner: what was fitted, in words.
        estimate: fitted to the whole sample, what estimates side-slip in rad of a drive; NaN where
            an input is null.
        signals: its inputs.
        cross_validated: figures on drives that it was not fitted on, pooled over the folds.
        rows: rows of the sample.
        training_s: time to fit the whole sample.
        size_bytes: what a car would have to carry.
        one_estimate_us: time of one estimate by itself, as on board; the median of many.
        each_of_many_us: time of each of many estimates at once.
        told: what a document says of it besides.
    """

    name: str
    learner: str
    estimate: Estimate
    signals: tuple[str, ...]
    cross_validated: ErrorFigures
    rows: int
    training_s: float
    size_bytes: int
    one_estimate_us: float
    each_of_many_us: float
    told: Mapping[str, Any] = field(default_factory=dict)

    def description(self) -> dict[str, Any]:
        """Return what a document says of it as an estimator."""
        return {"kind": "rival", "group": "rivals", "signals": list(self.signals), **self.told}

    def as_dict(self) -> dict[str, Any]:
        """Return what a document says of its accuracy and cost."""
        left_out = ("estimate", "told", "cross_validated", "signals")
        plain = {name: value for name, value in vars(self).items() if name not in left_out}
        figures = self.cross_validated.as_dict()
        return {**plain, "signals": list(self.signals), "cross_validated": figures}


TrainRivals = Callable[[Warehouse, Cohort, Manifest, Bank], Sequence[Rival]]
"""Trains the rivals on the rows of a cohort, also on the columns of a published model."""


@dataclass(frozen=True)
class Competitors:
    """All estimators that compete, by name, and what a document says of each."""

    one_car: TrainedModels
    fleets: tuple[TrainedModels, ...]
    rivals: tuple[Rival, ...]
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
            rivals=[rival.as_dict() for rival in self.competitors.rivals],
            ranking=self.ranking.as_dict(),
            gps_noise=self.gps_noise.as_dict() if self.gps_noise else None,
        )


def train_competitors(
    warehouse: Warehouse,
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
    train_rivals: TrainRivals | None,
) -> Competitors:
    """Fit, tune and train all that compete; filters and rivals get the one-car model's drives."""
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
    learned = train_rivals(warehouse, cohort, one_car.manifest, bank) if train_rivals else ()
    return Competitors(
        one_car=first,
        fleets=others,
        rivals=tuple(learned),
        estimators=estimators | bank.estimators | {one.name: one.estimate for one in learned},
        descriptions=(
            descriptions | bank.descriptions | {one.name: one.description() for one in learned}
        ),
    )


def evaluate(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
    train_rivals: TrainRivals | None = None,
) -> Evaluation:
    """Evaluate a model and all that competes with it on scenarios that are in the logs."""
    competitors = train_competitors(warehouse, one_car, fleets, executor, train_rivals)
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
