"""Evaluation on simulated drives: of the scenarios, and blind."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.evaluation.evaluated_drives import (
    CRITERIA,
    LabelledDrive,
    TestDrive,
    blind_scenarios,
    find_stretches,
    predict_drive,
    simulate_drives,
)
from fleet_slip.evaluation.evaluator import (
    Estimator,
    EvaluatedDrive,
    evaluate,
    pooled_statistics,
)
from fleet_slip.evaluation.filters import (
    GROUP,
    EstimatorBank,
    FilterEstimate,
    TrainedModels,
    filter_bank,
    load_or_tune,
    read_tuning_drives,
    train_models,
)
from fleet_slip.evaluation.measured_evaluation import combined_estimate, pair_estimates
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.score import calibrated_cars
from fleet_slip.regression.combination import PairedEstimates, fit_combination
from fleet_slip.simulation.scenario import Failure, Scenario, load_scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS, Gps
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.warehouse.warehouse import Warehouse


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
    predictor = Predictor.from_manifest(warehouse.catalog.signals, one_car.manifest)
    with_mass = "mass_kg" in predictor.plan.facts
    drives = read_tuning_drives(warehouse, trained[0].selection.cohort, with_mass=with_mass)
    car = load_scenario("nominal", warehouse.configs).car
    tuned = load_or_tune(warehouse, drives, car, executor, with_mass=with_mass)
    bank |= filter_bank(tuned, drives, with_mass=with_mass)
    cars = calibrated_cars(warehouse) if predictor.plan.numbers else {}
    line = partial(predict_drive, predictor, cars)
    return trained, bank | combination_bank(drives, line, car, one_car.reference, bank)


# Line and filter together, where the paper has its Kalman filter: without and with satellite
# navigation. The filters are those of the class of cars, tuned on training drives of the line.

COMBINATIONS = {"combination": "ekf_class_tuned", "combination_gps": "kalman_tuned"}
"""Filter of each combination with the evaluated model."""


def combination_bank(
    drives: Sequence[LabelledDrive],
    line: Estimator[LabelledDrive],
    default_car: VehicleParameters,
    model: str,
    bank: EstimatorBank,
) -> EstimatorBank:
    """Return the combinations of a model with filters that could be tuned, anchored at the model.

    On drives unlike the training drives, such as icy ones, the filter of a class is far less
    accurate than the model of a fleet; so the combination adds to the model a bounded share of the
    difference.
    """
    combined: EstimatorBank = {}
    for name, filter_name in COMBINATIONS.items():
        filtered, about = bank[filter_name]
        if not isinstance(filtered, FilterEstimate) or not about["tuned_on"]:
            continue
        in_class_car = partial(filtered.on_labelled, default_car)
        pairs = [
            pair_estimates(drive, line, in_class_car, drive.evaluated, number)
            for number, drive in enumerate(drives)
        ]
        if not any(map(len, pairs)):
            continue
        combination = fit_combination(PairedEstimates.concatenate(pairs), "line_by_lateral")
        combined[name] = (
            partial(combined_estimate, combination, bank[model][0], filtered),
            {
                "kind": "combination",
                "group": GROUP,
                "gps": about["gps"],
                "told": "class",
                "of": [model, filter_name],
                "combination": asdict(combination),
                "tuned_on": about["tuned_on"],
            },
        )
    return combined


def evaluate_simulated(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario] | None,
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate a model and its competitors; return the document.

    The drives are those of the scenarios, or if None the blind drives of the model.
    """
    (first, *fleet_models), bank = train_competitors(warehouse, one_car, fleets, executor)
    estimators = {name: estimator for name, (estimator, _) in bank.items()}
    document = {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "estimators": {name: about for name, (_, about) in bank.items()},
    }
    if scenarios is None:
        drives = evaluate_blind_drives(warehouse.catalog, one_car.sha256, estimators)
        return {**document, "model": one_car.reference, "drives": drives}
    runs = evaluate(simulate_drives(warehouse.catalog.signals, scenarios), estimators)
    not_ranked = {
        name for name, (_, about) in bank.items() if about.get("gps") or name in COMBINATIONS
    }
    return {
        **document,
        "scenarios": [_scenario_document(run) for run in runs],
        "logs_version": first.selection.cohort.logs_version,
        "grams_version": first.selection.cohort.grams_version,
        "comparisons": [
            row
            for fleet in fleet_models
            for row in compare_models(runs, first.table_one, fleet.table_one)
        ],
        "ranking": rank(runs, first.version.reference, not_ranked),
    }


def evaluate_blind_drives(
    catalog: Catalog, sha256: str, estimators: Mapping[str, Estimator[TestDrive]]
) -> list[dict[str, Any]]:
    """Evaluate estimators on the blind drives of a model version.

    Returns `results` by estimator over all drives together, then by class of road, by weather and
    by drive. The reference is the simulator's own, not quantised as in a log.
    """
    drives = simulate_drives(catalog.signals, blind_scenarios(sha256, catalog.configs))
    runs = evaluate(drives, estimators)
    groups = {"all": list(runs)}
    for word in (0, -1):
        for run in runs:
            groups.setdefault(run.name.split("_")[word], []).append(run)
    groups |= {run.name: [run] for run in runs}
    documents = []
    for name, group in groups.items():
        truth = np.concatenate([run.drive.sideslip_rad[run.rows] for run in group])
        documents.append(
            {
                "name": name,
                "drives": len(group),
                "sideslip_std_deg": float(np.degrees(truth.std())),
                "results": {key: asdict(row) for key, row in pooled_statistics(group).items()},
            }
        )
    return documents


def _scenario_document(run: EvaluatedDrive[TestDrive]) -> dict[str, Any]:
    drive, scenario, sections = run.drive, run.drive.scenario, run.drive.sections
    results = {name: asdict(statistics) for name, statistics in run.statistics.items()}
    for side, sign in (("inside", True), ("outside", False)):
        parts = {name: run.within(rows == sign) for name, rows in sections.items()}
        for estimator, result in results.items():
            result[side] = {n: asdict(part.statistics[estimator]) for n, part in parts.items()}
    sideslip_deg = np.degrees(drive.sideslip_rad[drive.evaluated])
    ay = drive.ay_mps2 - drive.scenario.sensors.ay_bias_mps2
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
        "truth": {
            "rows": len(drive.time_s),
            "duration_s": len(drive.time_s) / 100,
            "lost_control_s": drive.lost_control_s,
            "sideslip_std_deg": float(sideslip_deg.std()),
            "sideslip_max_deg": float(np.abs(sideslip_deg).max()),
            "speed_min_mps": float(drive.speed_mps.min()),
            "speed_max_mps": float(drive.speed_mps.max()),
            "lateral_offset_max_m": float(np.abs(drive.lateral_offset_m).max()),
            "lateral_acceleration_p99_mps2": float(np.nanquantile(np.abs(ay), 0.99)),
        },
        "sections": [
            {
                "name": name,
                "criterion": CRITERIA[name],
                "rows": int(rows.sum()),
                "stretches": find_stretches(drive, rows),
            }
            for name, rows in sections.items()
        ],
        "results": results,
    }


# Ranking of estimators on test drives, and comparison of models trained on two cohorts.

MIN_COVERAGE = 0.99
"""Share of a drive's rows with an estimate below which an estimator does not compete."""

NO_GPS = Gps(rate_hz=1, velocity_std_mps=0.0, time_between_outages_s=1.0, outage_duration_s=1.0)
"""Satellite navigation of all drives, where it does not matter."""

CLOSE = 1.25
"""Ratio to the winner's RMSE up to which a lost drive counts as close."""


def rank(
    runs: Sequence[EvaluatedDrive[TestDrive]], estimator: str, excluded: Collection[str]
) -> dict[str, Any]:
    """Rank an estimator on every drive against all but `excluded`; it wins a tie.

    Returns the section of a document, where the winner is None without competitors. Drives that
    differ in satellite navigation alone count once: `same_as` names the first.
    """
    first: dict[Any, str] = {}
    standings: list[dict[str, Any]] = []
    for run in runs:
        errors = {
            name: statistics.rmse_deg
            for name, statistics in run.statistics.items()
            if name not in excluded
            and statistics.rmse_deg is not None
            and statistics.coverage >= MIN_COVERAGE
        }
        rmse_deg = errors.get(estimator)
        winner = min(errors, key=lambda name: (errors[name], name != estimator), default="")
        winner_deg = errors.get(winner)
        key = _without_gps(run.drive.scenario)
        standings.append(
            {
                "scenario": run.name,
                "winner": winner or None,
                "winner_rmse_deg": winner_deg,
                "rmse_deg": rmse_deg,
                "won": winner == estimator,
                "ratio": rmse_deg / winner_deg if rmse_deg is not None and winner_deg else None,
                "same_as": first.get(key),
            }
        )
        first.setdefault(key, run.name)
    counted = [standing for standing in standings if standing["same_as"] is None]
    lost = [row["ratio"] for row in counted if row["ratio"] is not None and not row["won"]]
    return {
        "estimator": estimator,
        "least_coverage": MIN_COVERAGE,
        "close_ratio": CLOSE,
        "drives": len(counted),
        "won": sum(row["won"] for row in counted),
        "close": sum(ratio <= CLOSE for ratio in lost),
        "standings": standings,
    }


def _without_gps(scenario: Scenario) -> tuple[str, tuple[Failure, ...]]:
    """Return what of a scenario matters to an estimator without satellite navigation."""
    sensors = scenario.sensors.model_copy(update={"gps": NO_GPS})
    drive = scenario.model_copy(update={"drive": "any", "sensors": sensors}).batch()
    failures = tuple(f for f in scenario.failures if not set(f.signals) <= set(GPS_SIGNALS))
    return drive.digest, failures


def compare_models(
    runs: Sequence[EvaluatedDrive[TestDrive]],
    one_car: Mapping[str, str],
    fleet: Mapping[str, str],
) -> Iterator[dict[str, Any]]:
    """Compare the models of Table I of two cohorts, by number, wherever both have estimates."""
    for run in runs:
        for number in (number for number in one_car if number in fleet):
            names = one_car[number], fleet[number]
            one_car_deg, fleet_deg = (run.statistics[name].rmse_deg for name in names)
            if one_car_deg is not None and fleet_deg is not None:
                yield {
                    "scenario": run.name,
                    "model": number,
                    "one_car": names[0],
                    "fleet": names[1],
                    "one_car_rmse_deg": one_car_deg,
                    "fleet_rmse_deg": fleet_deg,
                    "better": names[0] if one_car_deg <= fleet_deg else names[1],
                }
