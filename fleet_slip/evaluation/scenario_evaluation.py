"""Evaluation on simulated drives: of the scenarios, and blind."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.evaluation.blind import evaluate_blind_drives
from fleet_slip.evaluation.evaluator import EvaluatedDrive, evaluate
from fleet_slip.evaluation.filters import (
    EstimatorBank,
    TrainedModels,
    TuningDrives,
    filter_bank,
    train_models,
)
from fleet_slip.evaluation.ranking import compare_models, rank
from fleet_slip.evaluation.test_drives import TestDrive, find_stretches, simulate_drives
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.warehouse.tables import Warehouse


def train_competitors(
    warehouse: Warehouse,
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> tuple[list[TrainedModels], EstimatorBank]:
    """Fit the models of Table I, and tune filters on the drives of the one-car model."""
    trained = [train_models(warehouse, version) for version in (one_car, *fleets)]
    bank: EstimatorBank = {}
    for models in trained:
        bank |= models.bank()
    with_mass = "mass_kg" in Predictor.of(warehouse.catalog.signals, one_car.manifest).plan.facts
    drives = TuningDrives.choose(warehouse, trained[0].selection.cohort, with_mass=with_mass)
    car = load_scenario("nominal", warehouse.configs).car
    return trained, bank | filter_bank(drives, car, executor)


def evaluate_scenarios(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate a model and its competitors on scenarios; return the document."""
    (first, *fleet_models), bank = train_competitors(warehouse, one_car, fleets, executor)
    estimators = {name: estimator for name, (estimator, _) in bank.items()}
    runs = evaluate(simulate_drives(warehouse.catalog.signals, scenarios), estimators)
    gps = {name for name, (_, about) in bank.items() if about.get("gps")}
    return {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "estimators": {name: about for name, (_, about) in bank.items()},
        "scenarios": [_scenario_document(run) for run in runs],
        "logs_version": first.selection.cohort.logs_version,
        "grams_version": first.selection.cohort.grams_version,
        "comparisons": [
            row
            for fleet in fleet_models
            for row in compare_models(runs, first.table_one, fleet.table_one)
        ],
        "ranking": rank(runs, first.version.reference, gps),
    }


def evaluate_blind(
    warehouse: Warehouse,
    model: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate on drives that follow from the model's hash; return the document."""
    _, bank = train_competitors(warehouse, model, fleets, executor)
    estimators = {name: estimator for name, (estimator, _) in bank.items()}
    return {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "model": model.reference,
        "estimators": {name: about for name, (_, about) in bank.items()},
        "drives": evaluate_blind_drives(warehouse.catalog, model.sha256, estimators),
    }


def _scenario_document(run: EvaluatedDrive[TestDrive]) -> dict[str, Any]:
    drive, scenario = run.drive, run.drive.scenario
    inside = {section.name: run.within(section.rows) for section in drive.sections}
    outside = {section.name: run.within(~section.rows) for section in drive.sections}

    def errors(name: str, part: EvaluatedDrive[TestDrive]) -> dict[str, Any]:
        return asdict(part.statistics[name])

    return {
        "name": scenario.name,
        "description": scenario.description,
        "paper": scenario.paper,
        "drive_id": scenario.drive_id,
        "vehicle_model": scenario.vehicle.name,
        "sprung_mass_kg": scenario.car.body.sprung_mass_kg,
        "adhesion": scenario.adhesion,
        "track": scenario.way.name,
        "failures": [failure.model_dump() for failure in scenario.failures],
        "truth": _truth_document(drive),
        "sections": [
            {
                "name": section.name,
                "criterion": section.criterion,
                "rows": int(section.rows.sum()),
                "stretches": list(map(asdict, find_stretches(drive, section.rows))),
            }
            for section in drive.sections
        ],
        "results": {
            name: {
                **errors(name, run),
                "inside": {section: errors(name, part) for section, part in inside.items()},
                "outside": {section: errors(name, part) for section, part in outside.items()},
            }
            for name in run.estimates
        },
    }


def _truth_document(drive: TestDrive) -> dict[str, Any]:
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
    }
