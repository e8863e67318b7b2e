"""How the sensors of every car are off, from the Gram rows of its drives: no label, no log row.

The parameters of a car are exact functions of the sums of its drives (`sensor_relations`) and of
what the roads of all cars have in common. They do not depend on the order of drives, and nothing of
an erased drive remains in them.

How sure they are follows from how much single drives move them: drives are the independent pieces
of evidence. One drive has no other to differ from, so that the variance of residuals, as drives
differ, is that of the whole fleet; how much a car's driving determines is its own. Drives go over
the same roads again, so that there is a limit to what more of them determine.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from fractions import Fraction
from math import hypot, sqrt
from statistics import median, pstdev
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.base import pluralize
from fleet_slip.calibration.receiver_delay import (
    LASTING_S,
    NO_RECEIVERS,
    ReceiverDelays,
    receiver_delays,
)
from fleet_slip.calibration.sensor_relations import (
    KINDS,
    LACKING,
    LASTING_BY_SATELLITE,
    CarEstimate,
    CarTerms,
    Estimates,
    bank_of_bends,
    estimate_numbers,
    kinds_by_set,
)
from fleet_slip.catalog.calibration_parameters import (
    CALIBRATION,
    CALIBRATION_PARAMETERS,
    DELAY,
    CalibrationParameterName,
)
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.drive_sources import ALL_DRIVES
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.exact import sqrt as sqrt_exact
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.regression.least_squares import DriveTermSums, ExactSums, influence
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.warehouse.gram_reader import GramReader, OpenedGrams, open_grams
from fleet_slip.warehouse.gram_rows import by_signals, gram_table
from fleet_slip.warehouse.predicate import Predicate, parse_predicate
from fleet_slip.warehouse.warehouse import Warehouse

# The sums of every drive of every car, from Gram rows that are read batch by batch.

Drive = tuple[str, date, str]
"""Car, day and name: the order in which a car drove."""


@dataclass(frozen=True)
class DriveSums:
    """Sums of columns over rows that have them all, by drive; `cars` tells where each begins."""

    drives: tuple[Drive, ...]
    table: GramTable
    cars: Mapping[str, slice]


def collect_sums(
    batches: Iterable[pa.RecordBatch],
    kinds: Mapping[str, tuple[str, ...]],
    *,
    lacking: Mapping[str, str] = MappingProxyType({}),
    unnamed: bool = False,
) -> dict[str, DriveSums]:
    """Return the sums of the columns of each kind over every drive that says whose it is.

    Rows that have the column that a kind is `lacking` are left out of it. With `unnamed` also over
    drives that do not say it, as of a car without a name.
    """
    parts: dict[str, list[GramTable]] = defaultdict(list)
    drives: dict[str, list[Drive]] = defaultdict(list)
    for batch in batches:
        some = batch if unnamed else batch.filter(batch["vehicle_id"].is_valid())
        for names, rows, _ in by_signals(some):
            if not len(rows):
                continue
            table = gram_table(names, rows)
            keys = (rows[key].to_pylist() for key in ("vehicle_id", "day", "drive_id"))
            of = [(str(car), day, drive) for car, day, drive in zip(*keys, strict=True)]
            for kind, columns in kinds.items():
                there = set(names.split(","))
                if set(columns) <= there and lacking.get(kind) not in there:
                    parts[kind].append(table.restrict(columns))
                    drives[kind] += of
    return {kind: _sorted(some, drives[kind]) for kind, some in parts.items()}


def _sorted(parts: Sequence[GramTable], rows: Sequence[Drive]) -> DriveSums:
    drives = sorted(set(rows))
    number = {drive: i for i, drive in enumerate(drives)}
    at = np.array([number[row] for row in rows], dtype=np.int64)
    names = ("n", "sums", "products")
    stacked = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    table = GramTable(parts[0].signals, *stacked).merged(at)
    cars: dict[str, slice] = {}
    for i, (car, _, _) in enumerate(drives):
        cars[car] = slice(cars[car].start if car in cars else i, i + 1)
    return DriveSums(tuple(drives), table, cars)


# What the roads of a fleet have in common: they lean to one side, and are banked in bends.
#
# No car alone separates a road that always leans from an accelerometer that is off. The offsets of
# many cars are of both signs; the road's lean is not. The median, which all share, is the road's.

FEWEST_CARS = 10
"""Fewer do not separate the road's lean and their own offsets."""

BANKED_M2PS2 = Fraction(-5)
"""Lateral acceleration that bends take per curvature, from which on roads are banked: half a
percent in bends of 100 m. Noise and slip make a fifth of it on flat ones."""

USUAL_LEAN_MPS2 = 0.2
"""A crown of 2 %: the standard error of a lean that is unknown."""

SURE = Fraction(31)
"""Square of three standard errors of a median over that of the median deviation and over one less
the number of cars: 3 x 1.2533 x 1.4826, of normal numbers."""


@dataclass(frozen=True)
class Roads:
    """The roads of a fleet.

    Attributes:
        banked: whether bends are, as far as can be determined.
        lean: m/s^2, what they add to every car's lateral acceleration; None if unknown.
        uncertainty: standard error of the lean.
        cars: how many determined it.
    """

    banked: bool
    lean: Fraction | None
    uncertainty: float
    cars: int

    @property
    def hide_offsets(self) -> bool:
        """Whether how an accelerometer is off cannot be separated from how the roads lean."""
        return self.banked and self.lean is None


def are_banked(banks: Sequence[Fraction]) -> bool:
    """Tell by the bank that each car met whether roads are banked: unless they surely are flat.

    Sure are three standard errors; fewer than `FEWEST_CARS` go by their median. The relation of
    banked roads holds on flat ones, too, but not the other way round.
    """
    if not banks:
        return False
    beyond = median(banks) - BANKED_M2PS2
    if beyond <= 0 or len(banks) < FEWEST_CARS:
        return beyond < 0
    return beyond**2 <= _square_of_three_errors(banks)


def roads_of(banked: bool, offsets: Sequence[Fraction]) -> Roads:
    """Return the roads by what each car's accelerometer says when it goes straight.

    The median less the part that may be of the cars: with m the median and e its standard error,
    m - (3 e)^2 / m, zero within three standard errors. So no car's number jumps as a fleet grows.
    What is left of it is uncertain as well.
    """
    if not banked:
        return Roads(banked, None, 0.0, len(offsets))
    if len(offsets) < FEWEST_CARS:
        return Roads(banked, None, USUAL_LEAN_MPS2, len(offsets))
    middle, square = median(offsets), _square_of_three_errors(offsets)
    left = middle if middle**2 <= square else square / middle
    return Roads(banked, middle - left, hypot(sqrt_exact(square) / 3, float(left)), len(offsets))


def _square_of_three_errors(values: Sequence[Fraction]) -> Fraction:
    middle = median(values)
    return SURE * median([abs(value - middle) for value in values]) ** 2 / len(values)


ROADS = 8
"""So many drives are as good as endless ones: more are on the same roads again, whose slopes are
the same."""

LEAST_PART = 1e-9
"""A drive of which the others of its car are less than this part has no other to differ from."""

PAIRS = 300
"""Cars of which two drives are compared: enough to determine a variance to a tenth."""

LASTING: Mapping[bool, Mapping[CalibrationParameterName, float]] = {
    False: {
        "steering_offset": 0.00004,
        "speed_ratio": 0.0015,
    },
    True: {
        "yaw_rate_offset": 0.0007,
        "steering_offset": 0.0002,
        "speed_ratio": 0.03,
    },
}
"""Standard errors that no drive takes away, on flat and on banked roads: noise flattens and wheels
slip. Where bends are banked, a body that leans 2 to 6 degrees per g makes its accelerometer say 3
to 10 % more, which is no speed."""


@dataclass(frozen=True)
class CalibratedNumber:
    """One number of one car.

    Attributes:
        value: in its SI unit; the exact rational rounded once.
        count: the integer count of its grain that models and boards use.
        uncertainty: standard error in the same unit; None if no car has two drives.
        drives, rows: what determines it.
    """

    value: float
    count: int
    uncertainty: float | None
    drives: int
    rows: int


LEANS = (
    "roads are banked, and may always lean to one side, which cannot be separated from the car's "
    f"own offset with fewer than {FEWEST_CARS} cars"
)
BEYOND = "it is outside the range of 16 bits"
"""Why a number is missing."""


class CarEvidence:
    """Sums of the drives of all cars, and the variance of residuals as drives differ."""

    def __init__(self, catalog: Catalog, sums: Mapping[str, DriveSums]) -> None:
        """Take the sums by kind of plane, and learn the variances."""
        self.sums, self._terms = sums, CarTerms(catalog)
        self._moments = {kind: one.table.moments() for kind, one in sums.items()}
        self.cars = sorted({car for one in sums.values() for car in one.cars})
        banks = [bank_of_bends(self._terms, self._totals(self.slices(car))) for car in self.cars]
        self._banked = are_banked([bank for bank in banks if bank is not None])
        self._whole = {car: self._estimate(self.slices(car)) for car in self.cars}
        self.estimates = {car: _known(whole) for car, whole in self._whole.items()}
        offsets = [one["ay_offset"].value for one in self.estimates.values() if "ay_offset" in one]
        self.roads = roads_of(self._banked, offsets)
        self.variances = self._variances()
        self.variances_of_one = self._variances_of_one()

    def slices(self, car: str, first: int = 0, last: int | None = None) -> dict[str, slice]:
        """Return where the drives `first` to `last` of a car stand, by kind."""
        found = {}
        for kind, one in self.sums.items():
            if car in one.cars:
                every = range(*one.cars[car].indices(len(one.drives)))[first:last]
                found[kind] = slice(every.start, every.stop)
        return found

    def means(self, car: str, terms: Sequence[str]) -> list[Fraction]:
        """Return means of terms of the relations of course over a car's drives; 0 of no drive."""
        totals = self._totals(self.slices(car))
        if not (course := totals.get("course")):
            return [Fraction(0) for _ in terms]
        sums = ExactSums(course, self._terms.course)
        return [sums.mean(term) for term in terms]

    def _totals(self, slices: Mapping[str, slice]) -> dict[str, Gram]:
        return {
            kind: self.sums[kind].table.take(at).total()
            for kind, at in slices.items()
            if at.stop > at.start
        }

    def estimate(self, slices: Mapping[str, slice]) -> dict[CalibrationParameterName, CarEstimate]:
        """Return the numbers that some drives determine, with the lean of their roads."""
        return _known(self._estimate(slices))

    def _estimate(self, slices: Mapping[str, slice]) -> Estimates:
        return estimate_numbers(self._terms, self._totals(slices), self._banked)

    def influence(self, estimate: CarEstimate, at: slice) -> tuple[FloatArray, FloatArray] | None:
        """Return how far drives move a number, and their shares of its variance."""
        signals = self.sums[estimate.kind].table.signals
        sums = DriveTermSums(self._moments[estimate.kind][at], signals, estimate.terms)
        return influence(estimate.relation, sums, float(estimate.noise), estimate.gradient)

    def _variances(self) -> dict[CalibrationParameterName, float]:
        """Return the variance of residuals, as drives differ, of each number's plane.

        A drive's shift, about the number of its car, has the variance times its share times one
        less the part of the share in the car's. Every drive counts the same: errors do not grow
        with shares as noise does, and uninformative drives would decide for informative ones.
        """
        ratios: dict[CalibrationParameterName, list[float]] = {}
        for car in self.cars:
            slices = self.slices(car)
            for name, estimate in self.estimates[car].items():
                found = self.influence(estimate, slices[estimate.kind])
                if found is None:
                    continue
                shifts, shares = found
                expected = shares * (1 - shares / shares.sum())
                alone = expected <= LEAST_PART * shares
                ratios.setdefault(name, []).extend(
                    (shifts[~alone] ** 2 / expected[~alone]).tolist()
                )
        return {name: sum(some) / len(some) for name, some in ratios.items() if some}

    def _variances_of_one(self) -> dict[CalibrationParameterName, float]:
        """Return the same of the numbers of one drive: how far a car's first two differ.

        What makes roads differ, such as the bank of their bends, moves a number that several roads
        determine at once; one road alone explains its own.
        """
        ratios: dict[CalibrationParameterName, list[float]] = {}
        pairs = [
            car for car in self.cars if all(s.stop - s.start > 1 for s in self.slices(car).values())
        ]
        for car in pairs[:PAIRS]:
            one, other = (self._of_drive(car, drive) for drive in (0, 1))
            for name in one.keys() & other.keys():
                apart = one[name][0] - other[name][0]
                ratios.setdefault(name, []).append(apart**2 / (one[name][1] + other[name][1]))
        return {name: sum(some) / len(some) for name, some in ratios.items()}

    def _of_drive(
        self, car: str, drive: int
    ) -> dict[CalibrationParameterName, tuple[float, float]]:
        """Return the numbers that a drive alone determines, and their shares."""
        at = self.slices(car, drive, drive + 1)
        found = {}
        for name, estimate in self.estimate(at).items():
            if (moved := self.influence(estimate, at[estimate.kind])) is not None:
                found[name] = float(estimate.value), float(moved[1].sum())
        return found

    def uncertainties(
        self, estimates: Mapping[CalibrationParameterName, CarEstimate], slices: Mapping[str, slice]
    ) -> dict[CalibrationParameterName, float]:
        """Return the standard errors of what some drives determine."""
        own: dict[CalibrationParameterName, float] = {}
        for name, estimate in estimates.items():
            found = self.influence(estimate, slices[estimate.kind])
            if found is None or name not in self.variances:
                continue
            drives, share = len(found[1]), float(found[1].sum())
            of_one = self.variances_of_one if drives == 1 else self.variances
            variance = of_one.get(name, self.variances[name]) * share
            lasting = {**LASTING[self._banked], **LASTING_BY_SATELLITE.get(estimate.kind, {})}
            own[name] = variance * (1 + drives / ROADS) + lasting.get(name, 0.0) ** 2
        found_of: dict[CalibrationParameterName, float] = {}
        for name, variance in own.items():
            one = estimates[name]
            others = sum(d**2 * own.get(other, 0.0) for other, d in one.also.items())
            lean = self.roads.uncertainty * float(one.by_lean)
            found_of[name] = sqrt(variance + others + lean**2)
        return found_of

    def stated(self, car: str) -> dict[CalibrationParameterName, "CalibratedNumber | str"]:
        """Return the numbers of a car, by all of its drives; why, in the place of a missing one.

        `ay_offset` is missing where it cannot be separated from the lean of the roads.
        """
        slices = self.slices(car)
        sure = self.uncertainties(self.estimates[car], slices)
        found: dict[CalibrationParameterName, CalibratedNumber | str] = {}
        for name, about in CALIBRATION_PARAMETERS.items():
            one = self._whole[car][name]
            if isinstance(one, str):
                found[name] = one
                continue
            value = one.value - (self.roads.lean or 0) * one.by_lean
            count, at = about.count(value), slices[one.kind]
            if name == "ay_offset" and self.roads.hide_offsets:
                found[name] = LEANS
            elif count is None:
                found[name] = BEYOND
            else:
                found[name] = CalibratedNumber(
                    value=float(value),
                    count=count,
                    uncertainty=three_digits(sure[name]) if name in sure else None,
                    drives=at.stop - at.start,
                    rows=int(self.sums[one.kind].table.n[at].sum()),
                )
        return found


def _known(estimates: Estimates) -> dict[CalibrationParameterName, CarEstimate]:
    return {name: one for name, one in estimates.items() if isinstance(one, CarEstimate)}


def three_digits(value: float) -> float:
    """Return an uncertainty as it is stated, which is the same on every machine."""
    return float(f"{value:.3g}")


@dataclass(frozen=True)
class Calibration(Answer):
    """The numbers of every car of a cohort.

    Attributes:
        cars: the numbers of each car, by its `vehicle_id`; a number is missing that its drives do
            not determine.
        missing: why, of each car.
        logs_version, grams_version: versions of the Delta tables that were read.
        evidence: sums and variances that the numbers came from.
        receivers: how late satellite receivers are, by the Gram rows of `delay` that there are.
    """

    cars: Mapping[str, Mapping[CalibrationParameterName, CalibratedNumber]]
    missing: Mapping[str, Mapping[CalibrationParameterName, str]]
    logs_version: int
    grams_version: int
    evidence: CarEvidence
    receivers: ReceiverDelays = NO_RECEIVERS

    def car(self, vehicle_id: str) -> Mapping[CalibrationParameterName, CalibratedNumber]:
        """Return the numbers of a car. Raises `QuestionError` if no drive is of it."""
        if vehicle_id not in self.cars:
            raise QuestionError(
                f"no drive of {vehicle_id!r} is enough to calibrate it. See: fleet-slip sql "
                '"SELECT DISTINCT vehicle_id FROM drives"'
            )
        return self.cars[vehicle_id]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the integer counts of every car's numbers."""
        return {
            car: {name: one.count for name, one in numbers.items()}
            for car, numbers in self.cars.items()
        }

    def parts(self, car: str | None = None) -> Iterator[Part]:
        """Return a table of the numbers over all cars, or those of a car and how they go on board.

        Raises `QuestionError` for an unknown car.
        """
        yield from self._of_all() if car is None else self._of_car(car)
        yield from self._remarks_on_roads()

    def _of_all(self) -> Iterator[Part]:
        rows = []
        for name, about in CALIBRATION_PARAMETERS.items():
            cars = [numbers[name] for numbers in self.cars.values() if name in numbers]
            known = [one.uncertainty for one in cars if one.uncertainty is not None]
            if cars:
                values = [one.value for one in cars]
                row = {"name": name, "unit": about.unit, "cars": len(cars)}
                row |= {"median": median(values), "spread": pstdev(values)}
                rows.append(row | {"known": median(known) if known else None})
        yield TextTable(
            f"{pluralize(len(self.cars), 'car')}, by their own drives",
            "number|unit|cars|median|differs by|known to +-",
            rows,
            "{name}|{unit}|{cars:,}|{median:.3g}|{spread:.2g}|{known:.2g}",
            text_columns=2,
        )
        if not any(one.uncertainty for cars in self.cars.values() for one in cars.values()):
            yield Remark("no car has two drives: uncertainties cannot be estimated")
        types = self._types_of_receivers()
        if types:
            yield TextTable(
                "\nhow late types of satellite receivers are",
                "type|cars|delay s|+-|differs by",
                ({"name": name, **one} for name, one in types.items()),
                "{name}|{cars:,}|{delay_s:.3f}|{uncertainty_s:.2g}|{spread_s:.2g}",
            )

    def _of_car(self, car: str) -> Iterator[Part]:
        yield TextTable(
            f"{car}, by its own drives",
            "number|unit|value|+-|drives|count on board|of",
            (
                {"name": k, "of": CALIBRATION_PARAMETERS[k], "one": one}
                for k, one in self.car(car).items()
            ),
            "{name}|{of.unit}|{one.value:.6g}|{one.uncertainty:.2g}|{one.drives}|{one.count}|"
            "{of.grain}",
            text_columns=2,
        )
        missing = self.missing[car]
        for reason in dict.fromkeys(missing.values()):
            names = [name for name, why in missing.items() if why == reason]
            are = "is" if len(names) == 1 else "are"
            yield Remark(f"{', '.join(names)} {are} missing: {reason}")
        if delay := self.receivers.cars.get(car):
            yield Remark(f"its satellite receiver is late by {delay}")

    def _types_of_receivers(self) -> dict[str, dict[str, float]]:
        cars = Counter(one.receiver for one in self.receivers.cars.values())
        return {
            name: {
                "cars": cars[name],
                "delay_s": one.mean,
                "uncertainty_s": hypot(one.mean_error, LASTING_S),
                "spread_s": one.spread,
                "spread_uncertainty_s": one.spread_error,
            }
            for name, one in self.receivers.types.items()
        }

    def _remarks_on_roads(self) -> Iterator[Remark]:
        if self.evidence.roads.hide_offsets:
            yield Remark(f"no car has ay_offset: {LEANS}")
        elif not self.evidence.roads.banked:
            yield Remark(
                "bends are seen not to be banked: a road that always leans to one side counts as "
                f"ay_offset. {FEWEST_CARS} cars or more separate the two"
            )

    def as_dict(self) -> dict[str, Any]:
        """Return what `calibrate --json` prints."""
        roads = self.evidence.roads
        return {
            "logs_version": self.logs_version,
            "grams_version": self.grams_version,
            "numbers": {
                name: one.model_dump(mode="json") for name, one in CALIBRATION_PARAMETERS.items()
            },
            "cars": {
                car: {name: vars(one) for name, one in numbers.items()}
                for car, numbers in self.cars.items()
            },
            "missing": {car: why for car, why in self.missing.items() if why},
            "roads": {
                "banked": roads.banked,
                "lean_mps2": None if roads.lean is None else float(roads.lean),
                "uncertainty": roads.uncertainty,
                "cars": roads.cars,
            },
            "receivers": {
                "cars": {
                    car: {
                        "receiver": one.receiver,
                        "delay_s": one.value,
                        "uncertainty_s": one.uncertainty,
                        "drives": one.drives,
                        "rows": one.rows,
                    }
                    for car, one in self.receivers.cars.items()
                },
                "types": self._types_of_receivers(),
            },
        }


def calibration_of(opened: OpenedGrams, predicate: Predicate) -> Calibration:
    """Return the numbers that Gram rows of `calibration` determine of every car of a cohort.

    With those of the sets that satellites determine more by, as far as there are any.
    """
    sums = collect_sums(opened.batches(predicate), KINDS, lacking=LACKING)
    catalog = opened.catalog
    for name, kinds in kinds_by_set(catalog.signals.label).items():
        if name in catalog.sets:
            satellite = replace(opened, identity=catalog.identity(name))
            sums |= collect_sums(satellite.batches(predicate), kinds)
    evidence = CarEvidence(catalog, sums)
    cars: dict[str, dict[CalibrationParameterName, CalibratedNumber]] = {}
    missing: dict[str, dict[CalibrationParameterName, str]] = {}
    for car in evidence.cars:
        stated = evidence.stated(car)
        missing[car] = {name: one for name, one in stated.items() if isinstance(one, str)}
        cars[car] = {name: one for name, one in stated.items() if not isinstance(one, str)}
    return Calibration(cars, missing, opened.logs_version, opened.grams_version, evidence)


def calibrate(
    source: Warehouse | GramReader,
    predicate: str | Predicate = ALL_DRIVES,
    *,
    receivers: bool = False,
) -> Calibration:
    """Return the numbers of every car that has drives of a cohort, from their Gram rows.

    Drives without a label count as others do; `receivers` asks how late these are, too. Raises
    `QuestionError` for an invalid predicate, and `DataError` if no drive satisfies it or the Gram
    rows of `calibration` are missing.
    """
    catalog = source.catalog
    predicate = parse_predicate(catalog.signals, predicate)
    with open_grams(source, CALIBRATION, predicate) as opened:
        calibration = calibration_of(opened, predicate)
        if receivers and DELAY in catalog.sets:
            delays = receiver_delays(
                replace(opened, identity=catalog.identity(DELAY)).batches(predicate)
            )
            calibration = replace(calibration, receivers=delays)
    if not calibration.cars:
        of = "" if predicate.text == ALL_DRIVES else f" of {predicate.quoted}"
        raise DataError(f"no drive{of} has yaw rate, ay and wheel speeds. Choose another cohort.")
    return calibration
