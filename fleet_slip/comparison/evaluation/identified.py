"""The extended Kalman filter in a car that was identified from the drives a model learned from.

It is what a department would build that has scales and a tape measure, labelled drives, and no tyre
measured: of the simulator's parameters it is given none that these do not tell.
"""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.estimators import Signals
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.filters import (
    GROUP,
    TuningDrives,
    choose_evenly,
    find_kept,
    seen,
)
from fleet_slip.comparison.observers import ekf
from fleet_slip.comparison.observers.drive_signals import LabelledDrive
from fleet_slip.comparison.observers.identification import Identified, Measured, identify
from fleet_slip.comparison.observers.tuning import checksum_of_sources
from fleet_slip.errors import DataError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.runs.log import LOGGER
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.warehouse.tables import Warehouse

NAME = "ekf_identified"

DRIVES_AT_MOST = 12
"""Of each class of cars a dozen tell as much, in half the time."""


@dataclass(frozen=True)
class IdentifiedEstimate:
    """The filter in the identified car of a class; in the first of another class that it knows."""

    cars: Mapping[str, Identified]
    driven: str

    def in_drive(self, drive: EvaluatedDrive) -> "IdentifiedEstimate":
        """Return the filter in the car of a drive."""
        known = drive.scenario.vehicle.name
        return replace(self, driven=known) if known in self.cars else self

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick."""
        car = self.cars[self.driven]
        return ekf.estimate(seen(signals), car.car, car.noise)

    def description(self) -> dict[str, Any]:
        """Return what a JSON document says of it."""
        return {
            "kind": "filter",
            "group": GROUP,
            "gps": False,
            "told": "labelled drives",
            "parameters": {name: _dumped(one) for name, one in self.cars.items()},
        }


def identified_estimate(
    warehouse: Warehouse, drives: TuningDrives, executor: Executor
) -> IdentifiedEstimate | None:
    """Identify each class of cars among drives; None where the drives do not allow it.

    What was found is kept below `tuned/` in the data root, and sought again only for other drives
    or another program.
    """
    key = {"drives": drives.key(), "program": checksum_of_sources()}
    kept = DocumentFolder(warehouse.root / "tuned" / "identified")
    found = find_kept(kept, key)
    if found is None:
        LOGGER.info("identifying the car, once")
        try:
            cars = {model: _dumped(one) for model, one in _identify(drives, executor).items()}
        except DataError as error:
            LOGGER.warning("no car can be identified from these drives: %s", error)
            return None
        found = {"key": key, "cars": cars}
        kept.append(found)
    identified = {model: _loaded(one) for model, one in found["cars"].items()}
    return IdentifiedEstimate(identified, next(iter(identified))) if identified else None


def _identify(drives: TuningDrives, executor: Executor) -> dict[str, Identified]:
    of_class: dict[str, list[LabelledDrive]] = {}
    for (_, model, _), drive in zip(drives.known, drives.read(), strict=True):
        if drive.car is not None:
            of_class.setdefault(model, []).append(replace(drive, car=None))
    return {
        model: identify(
            Measured.of(load_vehicle(model)), choose_evenly(own, DRIVES_AT_MOST), executor
        )
        for model, own in sorted(of_class.items())
    }


def _dumped(one: Identified) -> dict[str, Any]:
    return {
        "car": one.car.model_dump(mode="json"),
        "noise": one.noise.model_dump(mode="json"),
        "fit_rad": one.fit_rad,
    }


def _loaded(content: Mapping[str, Any]) -> Identified:
    return Identified(
        car=VehicleParameters.model_validate(content["car"]),
        noise=ekf.EkfNoise.model_validate(content["noise"]),
        fit_rad=content["fit_rad"],
    )
