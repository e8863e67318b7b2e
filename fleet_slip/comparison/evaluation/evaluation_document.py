"""An evaluation as a JSON document, kept below the data root as `evaluations/1.json`, 2.json ..."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario, Result, Section
from fleet_slip.comparison.evaluation.stability import find_stretches, rear_compliance
from fleet_slip.files.documents import Document, DocumentFolder, checksum
from fleet_slip.warehouse.tables import Warehouse

FORMAT = 1


def document(
    runs: Sequence[EvaluatedScenario], estimators: Mapping[str, Mapping[str, Any]], **further: Any
) -> dict[str, Any]:
    """Return the document of an evaluation.

    `estimators` describes each estimator by its name. It is a function of the logs, the models and
    the program: no time, no machine; `further` keys stand beside.
    """
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
        "sections": [_section(drive, section) for section in one.sections],
        "results": {name: _result(result) for name, result in one.results.items()},
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


def _section(drive: EvaluatedDrive, section: Section) -> dict[str, Any]:
    return {
        "name": section.name,
        "criterion": section.criterion,
        "rows": int(section.rows.sum()),
        "stretches": [asdict(stretch) for stretch in find_stretches(drive, section.rows)],
    }


def _result(result: Result) -> dict[str, Any]:
    return {
        **result.whole.as_dict(),
        "inside": {name: figures.as_dict() for name, figures in result.inside.items()},
        "outside": {name: figures.as_dict() for name, figures in result.outside.items()},
    }


def evaluations_of(warehouse: Warehouse) -> DocumentFolder:
    """Return where a data root keeps its evaluations."""
    return DocumentFolder(warehouse.root / "evaluations")


def keep(warehouse: Warehouse, content: Mapping[str, Any]) -> Document:
    """Add an evaluation, unless the latest one is the same; return its document."""
    documents = evaluations_of(warehouse)

    def attempt(newest: int) -> Document | None:
        if newest and (before := documents.read(newest)).sha256 == checksum(content):
            return before
        return documents.create(newest + 1, content)

    return documents.after_newest(attempt)
