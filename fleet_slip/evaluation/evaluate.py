"""An evaluation from end to end: who competes, on which drives, and the document of the result."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.base import number_of
from fleet_slip.evaluation.blind import judge_blindly
from fleet_slip.evaluation.drives import EvaluatedDrive, find_stretches, simulate_drives
from fleet_slip.evaluation.filters import (
    Bank,
    TrainedModels,
    TuningDrives,
    filter_bank,
    train_models,
)
from fleet_slip.evaluation.judge import EvaluatedScenario, compare_models, evaluate_drive, rank
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.storage.documents import Document, DocumentFolder, checksum
from fleet_slip.warehouse.tables import Warehouse


def train_competitors(
    warehouse: Warehouse,
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> tuple[list[TrainedModels], Bank]:
    """Fit and tune all that compete; filters get the one-car model's drives."""
    trained = [train_models(warehouse, version) for version in (one_car, *fleets)]
    bank: Bank = {}
    for one in trained:
        bank |= one.bank()
    weighed = "mass_kg" in Predictor.of(warehouse.catalog.signals, one_car.manifest).plan.facts
    drives = TuningDrives.of(warehouse, trained[0].selection.cohort, weighed=weighed)
    car = load_scenario("nominal", warehouse.configs).car
    return trained, bank | filter_bank(drives, car, executor, weighed=weighed)


def evaluate(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion],
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate a model and all that competes with it on scenarios.

    Returns the evaluation's document: of logs, models and program alone.
    """
    (first, *others), bank = train_competitors(warehouse, one_car, fleets, executor)
    estimators = {name: one for name, (one, _) in bank.items()}
    drives = simulate_drives(warehouse.catalog.signals, scenarios)
    runs = [evaluate_drive(drive, estimators) for drive in drives]
    gps = {name for name, (_, about) in bank.items() if about.get("gps")}
    return {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "estimators": {name: about for name, (_, about) in bank.items()},
        "scenarios": [_run(one) for one in runs],
        "logs_version": first.selection.cohort.logs_version,
        "grams_version": first.selection.cohort.grams_version,
        "comparisons": [
            row
            for fleet in others
            for row in compare_models(runs, first.table_one, fleet.table_one)
        ],
        "ranking": rank(runs, first.version.reference, gps),
    }


def evaluate_blindly(
    warehouse: Warehouse,
    model: ModelVersion,
    others: Sequence[ModelVersion],
    executor: Executor,
) -> "Evaluation":
    """Evaluate the same on drives that follow from the model's hash; nothing is written."""
    _, bank = train_competitors(warehouse, model, others, executor)
    content = {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "model": model.reference,
        "estimators": {name: about for name, (_, about) in bank.items()},
        "drives": judge_blindly(
            warehouse.catalog, model.sha256, {name: one for name, (one, _) in bank.items()}
        ),
    }
    return Evaluation(content)


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
        "track": scenario.way.name,
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
    }


BLIND_NAMES = 5
"""Estimators of the table that is printed first: published models, then the best of the others."""


@dataclass(frozen=True)
class Evaluation(Answer):
    """The document of an evaluation, and the number under which it is kept; a blind one is not."""

    DOCUMENT = "number? sha256? *content"

    content: Mapping[str, Any]
    number: int | None = None
    sha256: str = ""

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Return the summary, or the errors of all on every drive besides."""
        content, measured = self.content, "cohort" in self.content
        names = list(content["estimators"])
        if "scenarios" in content:
            drives, title = content["scenarios"], "Test drives: RMSE in deg"
            yield _ranking_table(content["ranking"])
            yield f"Pictures: fleet-slip report {shlex.quote(content['ranking']['estimator'])}"
        elif measured:
            drives, title = content["drives"], "RMSE in deg by drive"
            yield from _measured(content)
        else:
            drives, title = content["drives"], "Blind drives: RMSE in deg against the exact angle"
            errors = {name: one["rmse_deg"] for name, one in drives[0]["results"].items()}
            names.sort(key=lambda name: ("@" not in name, errors[name] is None, errors[name]))
            if not everything:
                groups = [one for one in drives if one["drives"] > 1]
                shown = [name for name in names if "/" not in name]
                yield _error_table(title, groups, shown[:BLIND_NAMES])
        if everything:
            yield _error_table(f"\n{title}", drives, names)
        else:
            yield "Every drive, and all estimators: --all; for machines --json."
        if self.number:
            yield Remark(f"kept as evaluations/{'measured/' if measured else ''}{self.number}.json")


def _error_table(
    title: str, drives: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> TextTable:
    """Return RMSE by drive and estimator, and of how much of the drive unless of all."""
    words = [name.replace("_", " ") for name in names]  # which a heading can wrap

    def error(found: Mapping[str, Any]) -> str:
        if found["rmse_deg"] is None:
            return "none"
        covered = found["coverage"]
        return f"{found['rmse_deg']:.3f}" + ("" if covered == 1 else f" ({covered:.0%})")

    rows = (
        [
            one["name"],
            f"{one.get('truth', one)['sideslip_std_deg']:.2f}",
            *(error(one["results"][name]) for name in names),
        ]
        for one in drives
    )
    return TextTable(title, "|".join(["drive", "side-slip std", *words]), rows)


def _ranking_table(ranking: Mapping[str, Any]) -> TextTable:
    """Return who wins each test drive."""
    least, ours = ranking["least_coverage"], ranking["estimator"]
    return TextTable(
        f"\n{ours} wins {ranking['won']} of {ranking['drives']} test drives by RMSE, and is within "
        f"{ranking['close_ratio']:g} of the winner on {ranking['close']} others.\nCompared are "
        f"estimators without GPS that cover {least:.0%} of the rows. Drives that differ only in "
        f"GPS count once. {ours}/3 is model 3 of Table I, trained on what {ours} was trained on.",
        f"scenario|won by|RMSE deg|{ours} deg|ratio",
        (one for one in ranking["standings"] if one["same_as"] is None),
        "{scenario}|{winner}|{winner_rmse_deg:.3f}|{rmse_deg:.3f}|{ratio:.2f}",
        left=2,
    )


def _measured(content: Mapping[str, Any]) -> Iterator[Part]:
    """Return figures on measured drives, the best estimator first."""
    drives = number_of(len(content["drives"]), "drive")
    left_out = "quarters of their time" if content["parts_of"] == "time" else "whole"
    kinds = ", ".join(f"{one['name']} ({len(one['drives'])})" for one in content["kinds"])
    yield TextTable(
        f"{content['cohort']}: {drives}, left out {left_out} in turn, in {content['parts']} parts",
        "estimator|knows|RMSE deg|±|mean|std|correlation|rows|worst|kinds left out",
        (
            {**one, "name": name, "kinds": (one["kinds_left_out"] or {}).get("rmse_deg")}
            for name, one in content["estimators"].items()
        ),
        "{name}|{told}|{rmse_deg:.3f}|{rmse_standard_error_deg:.3f}|{error_mean_deg:+.3f}|"
        "{error_std_deg:.3f}|{correlation:.3f}|{coverage:.0%}|{worst_drive_rmse_deg:.3f}|"
        "{kinds:.3f}",
        left=2,
    )
    yield (
        "±: standard error over drives; worst: RMSE of the drive that is estimated worst.\n"
        + (f"Kinds of driving: {kinds}." if kinds else "All drives are of one kind of driving.")
    )
    if content["vehicle"] is None:
        yield (
            "No filter was evaluated: the car is unknown. Give --mass, --front-axle and "
            "--rear-axle, or a vehicle file with --vehicle."
        )


def evaluations_of(warehouse: Warehouse, kind: str = "") -> DocumentFolder:
    """Return where a data root keeps its evaluations; `measured` are those on measured drives."""
    return DocumentFolder(warehouse.root, f"evaluations/{kind}" if kind else "evaluations")


def keep(documents: DocumentFolder, content: Mapping[str, Any]) -> Evaluation:
    """Add an evaluation, unless the latest one is the same; return it as it is kept."""

    def attempt(newest: int) -> Document | None:
        if newest in documents.numbers():  # else its loss was accepted
            before = documents.read(newest)
            if before.sha256 == checksum(content):
                return before
        return documents.create(newest + 1, content)

    return Evaluation(**vars(documents.after_newest(attempt)))
