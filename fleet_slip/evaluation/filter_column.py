"""The filter in an identified car as a column: an integer observer, and its blend with a line."""

import math
from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from fleet_slip.catalog.catalog import Catalog, integer_combination
from fleet_slip.catalog.definitions import (
    Blend,
    Definition,
    Observer,
    ObserverCar,
    ObserverInput,
    plain_column,
)
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.evaluated_drives import LabelledDrive, Segments
from fleet_slip.evaluation.evaluator import MissingSignalError
from fleet_slip.evaluation.identify import IdentifiedVehicle, identify, vehicle_with_fit
from fleet_slip.evaluation.measured_evaluation import (
    LATERAL_ROWS,
    Learner,
    cross_validate_combination,
    prepare_drive,
    read_measured_drives,
    training_drives,
)
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.manifest import CombinedWithFilter, Manifest, ModelTerm
from fleet_slip.models.summary import Selection
from fleet_slip.regression.combination import CLIP_STD, CombinationChoice
from fleet_slip.vehicle.parameters import VehicleMeasures
from fleet_slip.warehouse.warehouse import Warehouse

COUNT_RAD = Fraction(1, 2**16)
"""Count of the observer and of a combination with it."""

COLUMN_BITS = 20

COMBINED, FILTERED, LINE = "combined_with_filter", "filter_estimate", "line_estimate"
"""Names of the columns."""

WHEELS = {"rear": ("wheel_rl", "wheel_rr"), "front": ("wheel_fl", "wheel_fr")}


def observer_of(
    vehicle: IdentifiedVehicle, signals: SignalCatalog, logged: Collection[str], *, one_speed: bool
) -> Observer:
    """Return the observer of a car for the logged signals.

    `one_speed`: a single speed replaces those of all wheels. Raises `MissingSignalError`.
    """
    car, sensors = vehicle.car, vehicle.noise.sensors
    is_rear = one_speed or car.drivetrain.front_drive_share >= 0.5
    wheels = WHEELS["rear" if is_rear else "front"]
    steered = [name for name in ("steer_fl", "steer_fr") if name in logged]
    ratio = 1.0
    if not steered:
        steered, ratio = ["steering_wheel"], car.steering.ratio
    if missing := [n for n in ("ay", "yaw_rate", *wheels, *steered) if n not in logged]:
        raise MissingSignalError(
            f"the drives have no {', '.join(missing)}, which the filter needs."
        )

    def entry(
        names: Sequence[str], factor: float = 1.0, *, adds: bool = True, offset: float = 0.0
    ) -> ObserverInput:
        scale = float(signals[names[0]].scale) * factor / (len(names) if adds else 1)
        columns = tuple(Definition(of=name) for name in names)
        return ObserverInput(of=columns, scale=scale, adds=adds, offset=offset)

    radius = car.tyre.rolling_radius_m
    return Observer(
        ay=entry(["ay"], 1 / sensors.ay_gain, offset=sensors.ay_offset_mps2 / sensors.ay_gain),
        yaw_rate=entry(["yaw_rate"]),
        speed=entry(wheels[:1] if one_speed else wheels, radius),
        steer=entry(
            steered,
            1 / ratio / sensors.steer_gain,
            offset=sensors.steer_offset_rad / sensors.steer_gain,
        ),
        ax=entry(["ax"]) if "ax" in logged else None,
        wheels=None if one_speed else entry(wheels[::-1], radius, adds=False),
        axle="rear" if is_rear else "front",
        car=car_of(vehicle),
    )


def car_of(vehicle: IdentifiedVehicle) -> ObserverCar:
    """Return the numbers of an identified car and its filter."""
    car, noise = vehicle.car, vehicle.noise
    suspension, tyre = car.suspension, car.tyre
    numbers: dict[str, float] = {}
    for part in (car.body, suspension, tyre, noise, noise.yaw_rate):
        names = (name for name in ObserverCar.model_fields if hasattr(part, name))
        numbers |= {name: getattr(part, name) for name in names}
    front = tyre.peak_stiffness_n * suspension.front_stiffness_factor
    rear = tyre.peak_stiffness_n * suspension.rear_stiffness_factor
    numbers |= {
        "stiffness_front_n": front * noise.stiffness_front_factor,
        "stiffness_rear_n": rear * noise.stiffness_rear_factor,
        "stiffness_load_n": tyre.peak_stiffness_load_n,
        "friction": tyre.friction * noise.adhesion,
    }
    return ObserverCar(**numbers)


def with_filter(
    warehouse: Warehouse,
    manifest: Manifest,
    selection: Selection,
    measures: VehicleMeasures,
    executor: Executor,
) -> Manifest:
    """Return a manifest with the best combination of its line and a filter in the car.

    In every inner group of drives the car is identified and the line chosen again. If the drives
    lack what the filter needs, the line stays alone, with the reason.
    """
    predicate, nothing = selection.cohort.predicate.text, Segments()
    combined: dict[str, Any] = {"method": "line", "rmse_deg": {}, "worst_rmse_deg": {}, "groups": 0}
    try:
        drives = [
            prepare_drive(drive, vehicle_with_fit(measures))
            for drive in read_measured_drives(warehouse, load_cohort(warehouse, predicate))
        ]
        learner = Learner.prepare(warehouse, selection.request, predicate, drives)
        vehicle = identify(measures, training_drives(drives, nothing), executor)
        choice = cross_validate_combination(
            learner, measures, vehicle, nothing, executor, selection.cohort.prior
        )
        observer = observer_of_drives(vehicle, warehouse.catalog.signals, drives)
    except (DataError, QuestionError) as error:
        combined["reason"] = str(error)
    else:
        for name in ("rmse", "worst_rmse"):
            errors = getattr(choice, f"{name}_rad")
            combined[f"{name}_deg"] = {key: math.degrees(rad) for key, rad in errors.items()}
        combined |= {"method": choice.method, "groups": choice.groups}
        if choice.method != "line":
            combined["term"] = combined_term(warehouse.catalog, manifest, choice, observer)
    combination = CombinedWithFilter(measures=measures, **combined)
    return manifest.model_copy(update={"combination": combination})


def observer_of_drives(
    vehicle: IdentifiedVehicle, signals: SignalCatalog, drives: Sequence[LabelledDrive]
) -> Observer:
    """Return the observer of a car for the signals that all drives have."""
    logged = [
        name
        for name in signals.signals
        if all(
            name in drive.rows.column_names and drive.rows[name].null_count < len(drive.rows)
            for drive in drives
        )
    ]
    one_speed = all(
        np.array_equal(drive.signals.wheel_rl_rad_s, drive.signals.wheel_rr_rad_s, equal_nan=True)
        for drive in drives
    )
    return observer_of(vehicle, signals, logged, one_speed=one_speed)


def combined_term(
    catalog: Catalog, manifest: Manifest, choice: CombinationChoice, observer: Observer
) -> ModelTerm:
    """Return the column of a combination as the only term of an estimate."""
    combination, is_alone = choice.combination, choice.method == "filter"
    several = len(combination.knots_mps2) > 1
    ay_mps2 = float(catalog.signals["ay"].scale)
    blend = Blend(
        filter=Definition(of=FILTERED, made=observer, of_bits=COLUMN_BITS),
        line=None if is_alone else line_column(catalog, manifest),
        anchor=combination.anchor if not is_alone else "filter",
        shares=tuple(round(share * 2**16) for share in combination.line_share),
        limits=tuple(round(CLIP_STD * std * 2**16) for std in combination.std_rad),
        lateral=Definition(of="ay", over="mean", ticks=LATERAL_ROWS) if several else None,
        knots=tuple(round(knot / ay_mps2) for knot in combination.knots_mps2),
    )
    definition = Definition(of=COMBINED, made=blend, of_bits=COLUMN_BITS)
    return ModelTerm(
        signal=COMBINED,
        column=manifest.label.column,
        unit=manifest.label.unit,
        scale=Decimal(COUNT_RAD.numerator) / COUNT_RAD.denominator,
        definition=definition,
        signal_scales={name: catalog.signals[name].scale for name in definition.signals},
        coefficient=1.0,
        coefficient_exact=Fraction(1),
    )


def line_column(catalog: Catalog, manifest: Manifest) -> Definition:
    """Return the estimate of a manifest's terms as a column. Raises `QuestionError`."""
    columns = [term.definition or plain_column(term.signal, term.sql) for term in manifest.terms]
    scales = catalog.input_scales
    slopes = [
        term.coefficient_exact
        * (scales[term.signal] if term.logged else term.scale_exact)
        / COUNT_RAD
        for term in manifest.terms
    ]
    line = integer_combination(manifest.intercept_exact / COUNT_RAD, slopes, columns)
    return Definition(of=LINE, made=line, of_bits=COLUMN_BITS)
