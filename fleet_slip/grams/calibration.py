"""How the sensors of every car are off, from the Gram rows of its drives: no label, no log row.

The numbers of a car are exact functions of the sum of its drives' Gram rows (`car_estimates`) and
of what the roads of all cars have in common, so that they are the same in whatever order drives
came, and a drive that is forgotten is gone from them. `car_evidence` says how sure they are.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from statistics import median, pstdev
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.base import number_of
from fleet_slip.catalogue.course import COLUMNS, turned_scale
from fleet_slip.catalogue.facts import ALL_DRIVES, CALIBRATION, CAR_NUMBERS, NumberName
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.car_estimates import KINDS, LACKING, kinds_by_set
from fleet_slip.grams.car_evidence import (
    FEWEST_CARS,
    CalibratedNumber,
    CarEvidence,
    Roads,
)
from fleet_slip.grams.reader import GramReader, OpenedGrams, collect_sums, open_grams
from fleet_slip.grams.receiver_delay import (
    LASTING_S,
    RECEIVER_DELAY,
    SPREAD,
    ReceiverDelays,
    receiver_delays,
)
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.warehouse.condition import Condition, parse_condition
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Calibration(Answer):
    """The numbers of every car of a cohort.

    Attributes:
        cars: the numbers of each car, by its `vehicle_id`; a number is missing that its drives do
            not determine.
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
                f"no drive of a car {vehicle_id!r} determines its numbers. See: fleet-slip sql "
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

    def parts(self) -> Iterator[Part]:
        """Return a table of the numbers over all cars."""
        rows = []
        for name, about in CAR_NUMBERS.items():
            cars = [numbers[name] for numbers in self.cars.values() if name in numbers]
            known = [one.uncertainty for one in cars if one.uncertainty is not None]
            if cars:
                values = [one.value for one in cars]
                row = {"name": name, "unit": about.unit, "cars": len(cars)}
                row |= {"median": median(values), "spread": pstdev(values)}
                rows.append(row | {"known": median(known) if known else None})
        yield TextTable(
            f"{number_of(len(self.cars), 'car')}, by their own drives",
            "number|unit|cars|median|differs by|known to +-",
            rows,
            "{name}|{unit}|{cars:,}|{median:.3g}|{spread:.2g}|{known:.2g}",
            left=2,
        )
        if not any(one.uncertainty for cars in self.cars.values() for one in cars.values()):
            yield Remark("no car has two drives: uncertainties cannot be estimated")
        yield from self._remarks_on_roads()

    def parts_of_car(self, car: str) -> Iterator[Part]:
        """Return a table of a car's numbers, and why others are missing."""
        yield TextTable(
            f"{car}, by its own drives",
            "number|unit|value|+-|drives|count on board|of",
            ({"name": k, "of": CAR_NUMBERS[k], "one": one} for k, one in self.car(car).items()),
            "{name}|{of.unit}|{one.value:.6g}|{one.uncertainty:.2g}|{one.drives}|{one.count}|"
            "{of.grain}",
            left=2,
        )
        refusals = self.evidence.refusals(car)
        for reason in dict.fromkeys(refusals.values()):
            names = [name for name, why in refusals.items() if why == reason]
            are = "is" if len(names) == 1 else "are"
            yield Remark(f"{', '.join(names)} {are} missing: {reason}")
        yield from self._remarks_on_roads()

    def _remarks_on_roads(self) -> Iterator[Remark]:
        if self.roads.hide_offsets:
            yield Remark(
                "bends look banked, and roads may always lean to one side, which cannot be "
                f"separated from a sensor offset with fewer than {FEWEST_CARS} cars: no car has "
                "ay_offset"
            )
        elif not self.roads.banked:
            yield Remark(
                "bends are seen not to be banked: a road that always leans to one side counts as "
                f"ay_offset. {FEWEST_CARS} cars or more separate the two"
            )

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
    """Return the numbers that Gram rows of `calibration` determine of every car of a cohort.

    With those of the sets that satellites determine more by, as far as there are any.
    """
    sums = collect_sums(opened.batches(condition), KINDS, lacking=LACKING)
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

    Of the Gram rows that there are: none are required. `of_delay` are those of the set `delay`:
    how late satellite receivers are, also a row for each type, and one for its spread.
    """
    delays = receiver_delays(of_delay.batches(parse_condition(ALL_DRIVES)))
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
    return pa.Table.from_pylist([*rows, *_rows_of_delay(delays)], schema=TABLE)


def _rows_of_delay(delays: ReceiverDelays) -> Iterator[dict[str, Any]]:
    rows = [{"vehicle_id": car, **vars(one)} for car, one in delays.cars.items()]
    for name, one in delays.types.items():
        cars = [car for car in delays.cars.values() if car.receiver == name]
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


# What the course of each drive comes to, from the Gram rows of any set of changes of it.

Moments = Mapping[str, Mapping[str, FloatArray]]
"""Sums of products of 1, `COLUMNS` and the label in SI units, by car and drive, shape (6, 6)."""


def course_moments(reader: GramReader, condition: Condition) -> Moments:
    """Return the moments of each drive that has changes of the course.

    Of the first feature set whose Gram rows are there for the whole cohort; empty without one.
    """
    label = catalogue().label
    known = {name: float(scale) for name, scale in input_scales().items()}
    known |= {COLUMNS[-1]: turned_scale(), label: float(catalogue()[label].scale)}
    columns = (*COLUMNS, label)
    scales = np.array([1.0, *(known[name] for name in columns)])
    for name in features().sets:
        one = features().feature_set(name)
        if one.change_ticks and set(COLUMNS) <= set(one.columns):
            try:
                opened = reader.opened(name, condition)
            except DataError:  # it has not been computed, or not for all
                continue
            found = collect_sums(opened.batches(condition), {"course": columns}, unnamed=True)
            if sums := found.get("course"):
                moments = sums.table.moments() * np.outer(scales, scales)
                return {
                    car: {sums.drives[i][2]: moments[i] for i in range(at.start, at.stop)}
                    for car, at in sums.cars.items()
                }
    return {}
