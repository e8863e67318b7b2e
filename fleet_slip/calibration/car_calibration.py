"""Calibration of the sensors of each car from the Gram rows of its drives, without labels.

The parameters of a car are exact functions of the sums of its drives (`sensor_relations`) and of
what the roads of all cars have in common. They do not depend on the order of drives, and nothing of
an erased drive remains in them.

Uncertainties follow from the influence of single drives, which are independent observations. The
variance of residuals between drives is estimated from the whole fleet, since a single drive has no
other to differ from; the information in the driving is that of each car. Drives repeat the same
roads, so that the effective number of drives has a limit.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from fractions import Fraction
from math import hypot, sqrt
from statistics import median, pstdev
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record, document_of, pluralize
from fleet_slip.calibration.receiver_delay import (
    NO_RECEIVERS,
    SYSTEMATIC_STD_S,
    ReceiverDelays,
    receiver_delays,
)
from fleet_slip.calibration.sensor_relations import (
    EXCLUDED,
    KINDS,
    SYSTEMATIC_STD_BY_SATELLITE,
    CarEstimate,
    CarTerms,
    Estimates,
    bank_of_bends,
    estimate_parameters,
    kinds_by_set,
)
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import (
    CALIBRATION,
    CALIBRATION_PARAMETERS,
    DELAY,
    CalibrationParameterName,
)
from fleet_slip.catalog.signals import ALL_DRIVES
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.exact import sqrt as sqrt_exact
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.regression.least_squares import ExactSums, drive_term_sums, influence
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.warehouse.database import Predicate, parse_predicate
from fleet_slip.warehouse.gram_reader import (
    GramReader,
    OpenedGrams,
    by_signals,
    gram_table,
    open_grams,
)
from fleet_slip.warehouse.warehouse import Warehouse

# Sums of the drives of each car, from Gram rows read batch by batch.

Drive = tuple[str, date, str]
"""Car, day and name of a drive, which sort drives by time."""


@dataclass(frozen=True)
class DriveSums:
    """Sums of columns over the complete rows of each drive; `cars` are the drives of each car."""

    drives: tuple[Drive, ...]
    table: GramTable
    cars: Mapping[str, slice]


def collect_sums(
    batches: Iterable[pa.RecordBatch],
    kinds: Mapping[str, tuple[str, ...]],
    *,
    unnamed: bool = False,
) -> dict[str, DriveSums]:
    """Return the sums of the columns of each kind over the drives of named cars.

    Gram rows with the column of `EXCLUDED` do not count for a kind. `unnamed` includes drives of
    cars without a name.
    """
    tables: dict[str, list[GramTable]] = defaultdict(list)
    drives: dict[str, list[Drive]] = defaultdict(list)
    for batch in batches:
        named = batch if unnamed else batch.filter(batch["vehicle_id"].is_valid())
        for names, rows, _ in by_signals(named):
            if not len(rows):
                continue
            table, present = gram_table(names, rows), set(names.split(","))
            keys = (rows[key].to_pylist() for key in ("vehicle_id", "day", "drive_id"))
            row_drives = [(str(car), day, drive) for car, day, drive in zip(*keys, strict=True)]
            for kind, columns in kinds.items():
                if set(columns) <= present and EXCLUDED.get(kind) not in present:
                    tables[kind].append(table.restrict(columns))
                    drives[kind] += row_drives
    return {kind: _merge_by_drive(tables[kind], drives[kind]) for kind in tables}


def _merge_by_drive(tables: Sequence[GramTable], row_drives: Sequence[Drive]) -> DriveSums:
    drives = sorted(set(row_drives))
    numbers = {drive: i for i, drive in enumerate(drives)}
    drive_of_row = np.array([numbers[drive] for drive in row_drives], dtype=np.int64)
    names = ("n", "sums", "products")
    stacked = (np.concatenate([getattr(table, name) for table in tables]) for name in names)
    merged = GramTable(tables[0].signals, *stacked).merged(drive_of_row)
    cars: dict[str, slice] = {}
    for i, (car, _, _) in enumerate(drives):
        cars[car] = slice(cars[car].start if car in cars else i, i + 1)
    return DriveSums(tuple(drives), merged, cars)


# Roads of a fleet: camber, and bank in bends.
#
# A single car cannot separate camber from the offset of its accelerometer. The offsets of many cars
# have both signs, camber has one: the median of the fleet is the camber.

MIN_CARS = 10
"""Minimum number of cars that separates camber from the offsets of accelerometers."""

BANKED_M2PS2 = Fraction(-5)
"""Lateral acceleration per curvature in bends, below which roads count as banked: half a percent in
bends of 100 m. On flat roads noise and slip make a fifth of it."""

USUAL_CAMBER_MPS2 = 0.2
"""Standard error of an unknown camber: 2 %."""

NINE_VARIANCES = Fraction(31)
"""Square of three standard errors of a median, over the square of the median deviation and one over
the number of cars: (3 x 1.2533 x 1.4826)^2 for normal deviates."""


@dataclass(frozen=True)
class Roads(Record):
    """Roads of a fleet.

    Attributes
    ----------
    banked
        True unless bends are certainly flat.
    lean
        Camber as lateral acceleration of every car, m/s^2; None if unknown.
    uncertainty
        Standard error of the camber.
    cars
        Number of cars that determined it.
    """

    DOCUMENT = "banked lean_mps2 uncertainty cars"

    banked: bool
    lean: Fraction | None
    uncertainty: float
    cars: int

    @property
    def lean_mps2(self) -> float | None:
        """The camber as a float."""
        return None if self.lean is None else float(self.lean)

    @property
    def hide_offsets(self) -> bool:
        """Return True if camber and offsets of accelerometers cannot be separated."""
        return self.banked and self.lean is None


def are_banked(banks: Sequence[Fraction]) -> bool:
    """Return True unless roads are flat by three standard errors of the bank that cars met.

    With fewer than `MIN_CARS` cars the median decides. The relation of banked roads holds on flat
    ones, too, but not the other way round.
    """
    if not banks:
        return False
    excess = median(banks) - BANKED_M2PS2
    if excess <= 0 or len(banks) < MIN_CARS:
        return excess < 0
    return excess**2 <= _square_of_three_errors(banks)


def estimate_roads(banked: bool, offsets: Sequence[Fraction]) -> Roads:
    """Estimate the camber from the lateral acceleration of each car in straight driving.

    With the median m and its standard error e the camber is m - (3 e)^2 / m, and 0 within three
    standard errors. It is continuous, so that no offset jumps as a fleet grows.
    """
    if not banked:
        return Roads(banked, None, 0.0, len(offsets))
    if len(offsets) < MIN_CARS:
        return Roads(banked, None, USUAL_CAMBER_MPS2, len(offsets))
    middle, square = median(offsets), _square_of_three_errors(offsets)
    of_cars = middle if middle**2 <= square else square / middle
    error = hypot(sqrt_exact(square) / 3, float(of_cars))
    return Roads(banked, middle - of_cars, error, len(offsets))


def _square_of_three_errors(values: Sequence[Fraction]) -> Fraction:
    middle = median(values)
    return NINE_VARIANCES * median([abs(value - middle) for value in values]) ** 2 / len(values)


MAX_EFFECTIVE_DRIVES = 8
"""Cap on the effective number of drives: more are on the same roads again, whose errors are
correlated and do not average out."""

MIN_SHARE = 1e-9
"""Share of the other drives of a car, below which a drive has no other to differ from."""

MAX_PAIRS = 300
"""Cars whose first two drives are compared: enough for a variance to a tenth."""

SYSTEMATIC_STD: Mapping[bool, Mapping[CalibrationParameterName, float]] = {
    False: {"steering_offset": 0.00004, "speed_ratio": 0.0015},
    True: {"yaw_rate_offset": 0.0007, "steering_offset": 0.0002, "speed_ratio": 0.03},
}
"""Standard errors that drives do not average out, on flat and on banked roads, from the attenuation
by noise and from wheel slip. In banked bends, a body that rolls by 2 to 6 degrees per g adds 3 to
10 % to its accelerometer, which looks like speed."""


@dataclass(frozen=True)
class CalibratedParameter:
    """Calibration parameter of a car.

    Attributes
    ----------
    value
        In SI units; the exact rational, rounded once.
    count
        Multiple of the grain that models and boards use.
    uncertainty
        Standard error in SI units; None if no car has two drives.
    drives, rows
        Amount of data.
    """

    value: float
    count: int
    uncertainty: float | None
    drives: int
    rows: int


NOT_SEPARABLE = (
    "roads are banked, and may always lean to one side, which cannot be separated from the car's "
    f"own offset with fewer than {MIN_CARS} cars"
)
OUT_OF_RANGE = "it is outside the range of 16 bits"
"""Reasons for a missing parameter."""


class CarEvidence:
    """Sums of the drives of all cars, and the variance of residuals between drives."""

    def __init__(self, catalog: Catalog, sums: Mapping[str, DriveSums]) -> None:
        """Estimate the parameters of all cars, the roads and the variances from sums by kind."""
        self.sums, self._terms = sums, CarTerms(catalog)
        self._moments = {kind: of_kind.table.moments() for kind, of_kind in sums.items()}
        self.cars = sorted({car for of_kind in sums.values() for car in of_kind.cars})
        banks = [bank_of_bends(self._terms, self._totals(self.slices(car))) for car in self.cars]
        self._banked = are_banked([bank for bank in banks if bank is not None])
        self._results = {car: self._estimate(self.slices(car)) for car in self.cars}
        self.estimates = {car: _estimated(results) for car, results in self._results.items()}
        offsets = [
            estimates["ay_offset"].value
            for estimates in self.estimates.values()
            if "ay_offset" in estimates
        ]
        self.roads = estimate_roads(self._banked, offsets)
        self.variances = self._estimate_variances()
        self.single_drive_variances = self._estimate_single_drive_variances()

    def slices(self, car: str, first: int = 0, last: int | None = None) -> dict[str, slice]:
        """Return the positions of the drives `first` to `last` of a car, by kind."""
        positions = {}
        for kind, of_kind in self.sums.items():
            if car in of_kind.cars:
                drives = range(*of_kind.cars[car].indices(len(of_kind.drives)))[first:last]
                positions[kind] = slice(drives.start, drives.stop)
        return positions

    def means(self, car: str, terms: Sequence[str]) -> list[Fraction]:
        """Return means of terms of the relations of course over the drives of a car; 0 if none."""
        totals = self._totals(self.slices(car))
        if not (course := totals.get("course")):
            return [Fraction(0) for _ in terms]
        sums = ExactSums(course, self._terms.course)
        return [sums.mean(term) for term in terms]

    def _totals(self, slices: Mapping[str, slice]) -> dict[str, Gram]:
        return {
            kind: self.sums[kind].table.take(drives).total()
            for kind, drives in slices.items()
            if drives.stop > drives.start
        }

    def estimate(self, slices: Mapping[str, slice]) -> dict[CalibrationParameterName, CarEstimate]:
        """Estimate the parameters that some drives determine, including the camber."""
        return _estimated(self._estimate(slices))

    def _estimate(self, slices: Mapping[str, slice]) -> Estimates:
        return estimate_parameters(self._terms, self._totals(slices), self._banked)

    def influence(
        self, estimate: CarEstimate, drives: slice
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the shift of a parameter by each drive, and the drive's share of its variance."""
        signals = self.sums[estimate.kind].table.signals
        sums = drive_term_sums(self._moments[estimate.kind][drives], signals, estimate.terms)
        return influence(estimate.relation, sums, float(estimate.noise), estimate.gradient)

    def _estimate_variances(self) -> dict[CalibrationParameterName, float]:
        """Estimate the variance of residuals between drives, for each parameter.

        The shift of a drive about the parameter of its car has the variance times its share times
        one less the fraction of the share in the car's. All drives have equal weight: errors do not
        grow with shares as noise does, and uninformative drives would dominate informative ones.
        """
        ratios: dict[CalibrationParameterName, list[float]] = {}
        for car in self.cars:
            slices = self.slices(car)
            for name, estimate in self.estimates[car].items():
                effect = self.influence(estimate, slices[estimate.kind])
                if effect is None:
                    continue
                shifts, shares = effect
                expected = shares * (1 - shares / shares.sum())
                several = ~(expected <= MIN_SHARE * shares)
                ratios.setdefault(name, []).extend(
                    (shifts[several] ** 2 / expected[several]).tolist()
                )
        return {name: sum(values) / len(values) for name, values in ratios.items() if values}

    def _estimate_single_drive_variances(self) -> dict[CalibrationParameterName, float]:
        """Estimate the same for parameters of one drive, from the first two drives of each car.

        Differences between roads, such as the bank of their bends, shift a parameter that several
        roads determine together; one road alone explains its own.
        """
        ratios: dict[CalibrationParameterName, list[float]] = {}
        cars = [
            car for car in self.cars if all(s.stop - s.start > 1 for s in self.slices(car).values())
        ]
        for car in cars[:MAX_PAIRS]:
            first, second = (self._estimate_drive(car, drive) for drive in (0, 1))
            for name in first.keys() & second.keys():
                (value, share), (other_value, other_share) = first[name], second[name]
                ratios.setdefault(name, []).append(
                    (value - other_value) ** 2 / (share + other_share)
                )
        return {name: sum(values) / len(values) for name, values in ratios.items()}

    def _estimate_drive(
        self, car: str, drive: int
    ) -> dict[CalibrationParameterName, tuple[float, float]]:
        """Return the parameters that a drive alone determines, and their shares."""
        slices = self.slices(car, drive, drive + 1)
        values = {}
        for name, estimate in self.estimate(slices).items():
            if (effect := self.influence(estimate, slices[estimate.kind])) is not None:
                values[name] = float(estimate.value), float(effect[1].sum())
        return values

    def uncertainties(
        self, estimates: Mapping[CalibrationParameterName, CarEstimate], slices: Mapping[str, slice]
    ) -> dict[CalibrationParameterName, float]:
        """Return the standard errors of parameters that some drives determine."""
        variances: dict[CalibrationParameterName, float] = {}
        for name, estimate in estimates.items():
            effect = self.influence(estimate, slices[estimate.kind])
            if effect is None or name not in self.variances:
                continue
            drives, share = len(effect[1]), float(effect[1].sum())
            by_count = self.single_drive_variances if drives == 1 else self.variances
            variance = by_count.get(name, self.variances[name]) * share
            systematic = {
                **SYSTEMATIC_STD[self._banked],
                **SYSTEMATIC_STD_BY_SATELLITE.get(estimate.kind, {}),
            }
            variances[name] = (
                variance * (1 + drives / MAX_EFFECTIVE_DRIVES) + systematic.get(name, 0.0) ** 2
            )
        errors: dict[CalibrationParameterName, float] = {}
        for name, variance in variances.items():
            estimate = estimates[name]
            inherited = sum(d**2 * variances.get(key, 0.0) for key, d in estimate.also.items())
            camber = self.roads.uncertainty * float(estimate.by_lean)
            errors[name] = sqrt(variance + inherited + camber**2)
        return errors

    def parameters(self, car: str) -> dict[CalibrationParameterName, "CalibratedParameter | str"]:
        """Return the parameters of a car by all of its drives, or the reasons for missing ones.

        `ay_offset` is missing if it cannot be separated from the camber of the roads.
        """
        slices = self.slices(car)
        errors = self.uncertainties(self.estimates[car], slices)
        parameters: dict[CalibrationParameterName, CalibratedParameter | str] = {}
        for name, definition in CALIBRATION_PARAMETERS.items():
            estimate = self._results[car][name]
            if isinstance(estimate, str):
                parameters[name] = estimate
                continue
            value = estimate.value - (self.roads.lean or 0) * estimate.by_lean
            count, drives = definition.count(value), slices[estimate.kind]
            if name == "ay_offset" and self.roads.hide_offsets:
                parameters[name] = NOT_SEPARABLE
            elif count is None:
                parameters[name] = OUT_OF_RANGE
            else:
                parameters[name] = CalibratedParameter(
                    value=float(value),
                    count=count,
                    uncertainty=three_digits(errors[name]) if name in errors else None,
                    drives=drives.stop - drives.start,
                    rows=int(self.sums[estimate.kind].table.n[drives].sum()),
                )
        return parameters


def _estimated(results: Estimates) -> dict[CalibrationParameterName, CarEstimate]:
    """Return the estimates without the reasons for missing ones."""
    return {name: e for name, e in results.items() if isinstance(e, CarEstimate)}


def three_digits(value: float) -> float:
    """Round an uncertainty to three digits, which are the same on every machine."""
    return float(f"{value:.3g}")


@dataclass(frozen=True)
class Calibration(Answer):
    """Calibration parameters of the cars of a cohort.

    Attributes
    ----------
    cars
        The parameters of each car by `vehicle_id`, as far as its drives determine them.
    missing
        Reasons for missing parameters, by car.
    logs_version, grams_version
        Versions of the Delta tables that were read.
    evidence
        Sums and variances that the parameters follow from.
    receivers
        Delays of satellite receivers, from the Gram rows of `delay`.
    """

    cars: Mapping[str, Mapping[CalibrationParameterName, CalibratedParameter]]
    missing: Mapping[str, Mapping[CalibrationParameterName, str]]
    logs_version: int
    grams_version: int
    evidence: CarEvidence
    receivers: ReceiverDelays = NO_RECEIVERS

    def car(self, vehicle_id: str) -> Mapping[CalibrationParameterName, CalibratedParameter]:
        """Return the parameters of a car. Raises `QuestionError` for a car without a drive."""
        if vehicle_id not in self.cars:
            raise QuestionError(
                f"no drive of {vehicle_id!r} is enough to calibrate it. See: fleet-slip sql "
                '"SELECT DISTINCT vehicle_id FROM drives"'
            )
        return self.cars[vehicle_id]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the counts of the parameters of each car."""
        return {
            car: {name: parameter.count for name, parameter in parameters.items()}
            for car, parameters in self.cars.items()
        }

    def parts(self, car: str | None = None) -> Iterator[Part]:
        """Return a table of the parameters of all cars, or of one car with its counts on board.

        Raises `QuestionError` for an unknown car.
        """
        yield from self._of_all() if car is None else self._of_car(car)
        yield from self._remarks_on_roads()

    def _of_all(self) -> Iterator[Part]:
        rows = []
        for name, definition in CALIBRATION_PARAMETERS.items():
            cars = [parameters[name] for parameters in self.cars.values() if name in parameters]
            errors = [car.uncertainty for car in cars if car.uncertainty is not None]
            if cars:
                values = [car.value for car in cars]
                row = {"name": name, "unit": definition.unit, "cars": len(cars)}
                row |= {"median": median(values), "std": pstdev(values)}
                rows.append(row | {"error": median(errors) if errors else None})
        yield TextTable(
            f"{pluralize(len(self.cars), 'car')}, by their own drives",
            "parameter|unit|cars|median|differs by|known to +-",
            rows,
            "{name}|{unit}|{cars:,}|{median:.3g}|{std:.2g}|{error:.2g}",
            text_columns=2,
        )

    def _of_car(self, car: str) -> Iterator[Part]:
        yield TextTable(
            f"{car}, by its own drives",
            "parameter|unit|value|+-|drives|count on board|of",
            (
                {"name": name, "definition": CALIBRATION_PARAMETERS[name], "car": parameter}
                for name, parameter in self.car(car).items()
            ),
            "{name}|{definition.unit}|{car.value:.6g}|{car.uncertainty:.2g}|{car.drives}|"
            "{car.count}|{definition.grain}",
            text_columns=2,
        )
        for name, reason in self.missing[car].items():
            yield Remark(f"{name} is missing: {reason}")
        if delay := self.receivers.cars.get(car):
            yield Remark(f"its satellite receiver is late by {delay}")

    def _types_of_receivers(self) -> dict[str, dict[str, float]]:
        cars = Counter(delay.receiver for delay in self.receivers.cars.values())
        return {
            name: {
                "cars": cars[name],
                "delay_s": pooled.mean,
                "uncertainty_s": hypot(pooled.mean_error, SYSTEMATIC_STD_S),
                "spread_s": pooled.spread,
                "spread_uncertainty_s": pooled.spread_error,
            }
            for name, pooled in self.receivers.types.items()
        }

    def _remarks_on_roads(self) -> Iterator[Remark]:
        if self.evidence.roads.hide_offsets:
            yield Remark(f"no car has ay_offset: {NOT_SEPARABLE}")
        elif not self.evidence.roads.banked:
            yield Remark(
                "bends are not banked: a road that always leans to one side counts as "
                f"ay_offset. {MIN_CARS} cars or more separate the two"
            )

    def as_dict(self) -> dict[str, Any]:
        """Return what `calibrate --json` prints."""
        document = {
            "logs_version": self.logs_version,
            "grams_version": self.grams_version,
            "numbers": {
                name: vars(definition) | {"grain": str(definition.grain)}
                for name, definition in CALIBRATION_PARAMETERS.items()
            },
            "cars": self.cars,
            "missing": {car: reasons for car, reasons in self.missing.items() if reasons},
            "roads": self.evidence.roads,
            "receivers": {"cars": self.receivers.cars, "types": self._types_of_receivers()},
        }
        return {key: document_of(value) for key, value in document.items()}


def calibration_of(opened: OpenedGrams, predicate: Predicate) -> Calibration:
    """Estimate the parameters of the cars of a cohort from the Gram rows of `calibration`.

    Uses the feature sets with satellite signals, too, if they were computed.
    """
    sums = collect_sums(opened.batches(predicate), KINDS)
    catalog = opened.catalog
    for name, kinds in kinds_by_set(catalog.signals.label).items():
        if name in catalog.sets:
            satellite = replace(opened, identity=catalog.identity(name))
            sums |= collect_sums(satellite.batches(predicate), kinds)
    evidence = CarEvidence(catalog, sums)
    cars: dict[str, dict[CalibrationParameterName, CalibratedParameter]] = {}
    missing: dict[str, dict[CalibrationParameterName, str]] = {}
    for car in evidence.cars:
        parameters = evidence.parameters(car)
        missing[car] = {name: p for name, p in parameters.items() if isinstance(p, str)}
        cars[car] = {name: p for name, p in parameters.items() if not isinstance(p, str)}
    return Calibration(cars, missing, opened.logs_version, opened.grams_version, evidence)


def calibrate(
    source: Warehouse | GramReader,
    predicate: str | Predicate = ALL_DRIVES,
    *,
    receivers: bool = False,
) -> Calibration:
    """Calibrate the cars of a cohort from their Gram rows; labels are not needed.

    `receivers` includes the delays of satellite receivers. Raises `QuestionError` for an invalid
    predicate, and `DataError` if no drive satisfies it or Gram rows of `calibration` are missing.
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
        cohort = "" if predicate.text == ALL_DRIVES else f" of {predicate.quoted}"
        raise DataError(
            f"no drive{cohort} has yaw rate, ay and wheel speeds. Choose another cohort."
        )
    return calibration
