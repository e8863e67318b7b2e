"""How the sensors of every car are off, from the Gram rows of its drives: no label, no log row.

The numbers of a car are exact functions of the sum of its drives' Gram rows (`car_numbers`) and of
what the roads of all cars have in common (`road_lean`), so that they are the same in whatever order
drives came, and a drive that is forgotten is gone from them. `car_evidence` tells how sure they
are, `numbers_over_drives` what more drives make of them.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

import pyarrow as pa

from fleet_slip.catalogue.car_numbers import CALIBRATION, CAR_NUMBERS, NumberName
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.dates import date_of
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.calibration.car_evidence import CalibratedNumber, CarEvidence
from fleet_slip.grams.calibration.numbers_over_drives import (
    ChangedNumber,
    Convergence,
    changed_numbers,
    convergence,
)
from fleet_slip.grams.calibration.road_lean import Roads
from fleet_slip.grams.calibration.tell_by_satellite import kinds_by_set
from fleet_slip.grams.calibration.tell_numbers import KINDS
from fleet_slip.grams.cohorts.drive_sums import collect_sums
from fleet_slip.grams.cohorts.gram_reader import GramReader, OpenedGrams, open_grams
from fleet_slip.grams.rows.receiver_delay import (
    LASTING_S,
    RECEIVER_DELAY,
    SPREAD,
    ReceiverDelays,
    receiver_delays,
)
from fleet_slip.warehouse.condition import Condition, parse_condition
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Calibration:
    """The numbers of every car of a cohort.

    Attributes:
        cars: the numbers of each car, by its `vehicle_id`; a number is missing that its drives do
            not tell.
        logs_version, grams_version: versions of the Delta tables that were read.
        evidence: sums and variances that the numbers came from.
    """

    cars: Mapping[str, Mapping[NumberName, CalibratedNumber]]
    logs_version: int
    grams_version: int
    evidence: CarEvidence

    def car(self, vehicle_id: str) -> Mapping[NumberName, CalibratedNumber]:
        """Return the numbers of a car. Raises `QuestionError` if no drive is of it."""
        if vehicle_id not in self.cars:
            raise QuestionError(
                f"no drive of a car {vehicle_id!r} tells its numbers. See: fleet-slip sql "
                '"SELECT DISTINCT vehicle_id FROM drives"'
            )
        return self.cars[vehicle_id]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the integer counts of every car's numbers."""
        return {
            car: {name: one.count for name, one in numbers.items()}
            for car, numbers in self.cars.items()
        }

    @property
    def roads(self) -> Roads:
        """What the roads of all cars have in common."""
        return self.evidence.roads

    def changed(self, since: date | str) -> list[ChangedNumber]:
        """Return the numbers of cars that are others from a day on."""
        return changed_numbers(self.evidence, date_of(since, "since"))

    def convergence(self) -> tuple[Convergence, ...]:
        """Return how sure the numbers are after 1, 2, 5, 10 ... drives of a car."""
        return convergence(self.evidence)

    def as_dict(self) -> dict[str, Any]:
        """Return what `calibrate --json` prints."""
        return {
            "logs_version": self.logs_version,
            "grams_version": self.grams_version,
            "numbers": {name: one.model_dump(mode="json") for name, one in CAR_NUMBERS.items()},
            "cars": {
                car: {name: vars(one) for name, one in numbers.items()}
                for car, numbers in self.cars.items()
            },
            "missing": {
                car: refused for car in self.cars if (refused := self.evidence.refusals(car))
            },
            "roads": {
                "banked": self.roads.banked,
                "lean_mps2": None if self.roads.lean is None else float(self.roads.lean),
                "uncertainty": self.roads.uncertainty,
                "cars": self.roads.cars,
            },
            "convergence": [vars(one) for one in self.convergence()],
        }


TABLE = pa.schema(
    [
        ("vehicle_id", pa.string()),
        ("receiver", pa.string()),
        ("number", pa.string()),
        ("value", pa.float64()),
        ("uncertainty", pa.float64()),
        ("unit", pa.string()),
        ("count", pa.int64()),
        ("grain", pa.float64()),
        ("drives", pa.int64()),
        ("rows", pa.int64()),
        ("cars", pa.int64()),
    ]
)
"""The table `calibration`. A row of a type of receiver has no `vehicle_id`, but `cars`."""


def calibration_of(opened: OpenedGrams, condition: Condition) -> Calibration:
    """Return the numbers that Gram rows of `calibration` tell of every car of a cohort.

    With those of the sets that satellites tell more by, as far as there are any.
    """
    sums = collect_sums(opened.batches(condition), KINDS)
    known = features()
    for name, kinds in kinds_by_set().items():
        if name in known.sets:
            beside = replace(opened, identity=known.identity(name))
            sums |= collect_sums(beside.batches(condition), kinds)
    evidence = CarEvidence(sums)
    cars = {car: evidence.calibrated(car) for car in evidence.cars}
    return Calibration(cars, opened.logs_version, opened.grams_version, evidence)


def calibration_table(opened: OpenedGrams, of_delay: OpenedGrams) -> pa.Table:
    """Return the table `calibration` that SQL sees: a row for each car and number.

    Of the Gram rows that there are: none are required. `of_delay` are those of the set `delay`,
    which tell how late satellite receivers are: also a row for each type, and one for its spread.
    """
    told = receiver_delays(of_delay.batches(parse_condition(ALL_DRIVES)))
    found = calibration_of(opened, parse_condition(ALL_DRIVES))
    rows = [
        {
            "vehicle_id": car,
            "number": name,
            **vars(one),
            "unit": CAR_NUMBERS[name].unit,
            "grain": float(CAR_NUMBERS[name].grain),
        }
        for car, numbers in found.cars.items()
        for name, one in numbers.items()
    ]
    return pa.Table.from_pylist([*rows, *_rows_of_delay(told)], schema=TABLE)


def _rows_of_delay(told: ReceiverDelays) -> Iterator[dict[str, Any]]:
    rows = [{"vehicle_id": car, **vars(one)} for car, one in told.cars.items()]
    for name, one in told.types.items():
        cars = [car for car in told.cars.values() if car.receiver == name]
        of_type = {
            "receiver": name,
            "cars": len(cars),
            "drives": sum(car.drives for car in cars),
            "rows": sum(car.rows for car in cars),
        }
        error = math.hypot(one.mean_error, LASTING_S)
        rows.append({**of_type, "value": one.mean, "uncertainty": error})
        spread = {"number": SPREAD, "value": one.spread, "uncertainty": one.spread_error}
        rows.append({**of_type, **spread})
    grain = float(SAMPLE_TIME_S)
    for row in rows:
        count = round(row["value"] / grain)
        yield {"number": RECEIVER_DELAY, "unit": "s", "count": count, "grain": grain, **row}


def calibrate(
    source: Warehouse | GramReader, condition: str | Condition = ALL_DRIVES
) -> Calibration:
    """Return the numbers of every car that has drives of a cohort, from their Gram rows.

    Drives without a label count as others do. Raises `QuestionError` for an invalid condition,
    and `DataError` if no drive satisfies it or the Gram rows of `calibration` are missing.
    """
    condition = parse_condition(condition)
    with open_grams(source, CALIBRATION, condition) as opened:
        found = calibration_of(opened, condition)
    if not found.cars:
        of = "" if condition.text == ALL_DRIVES else f" of {condition.text!r}"
        raise DataError(f"no drive{of} has yaw rate, ay and wheel speeds. Choose another cohort.")
    return found
