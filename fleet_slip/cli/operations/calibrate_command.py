"""How the sensors of cars are off: the command calibrate."""

from collections.abc import Mapping, Sequence
from datetime import date
from statistics import median, pstdev
from typing import Annotated

import typer

from fleet_slip.catalogue.car_numbers import CAR_NUMBERS, NumberName
from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.cli.options import Cohort
from fleet_slip.cli.output import Json, cell, print_json, print_table, say
from fleet_slip.dates import date_of
from fleet_slip.grams.calibration.calibration import Calibration
from fleet_slip.grams.calibration.car_evidence import CalibratedNumber
from fleet_slip.grams.calibration.numbers_over_drives import SURE_ERRORS, ChangedNumber
from fleet_slip.grams.calibration.road_lean import FEWEST_CARS, Roads
from fleet_slip.words import number_of


def calibrate(
    context: typer.Context,
    car: Annotated[
        str | None,
        typer.Option(help="Show this car's numbers, and how they go on board.", show_default=False),
    ] = None,
    cohort: Cohort = ALL_DRIVES,
    since: Annotated[
        str | None,
        typer.Option(
            help="Show instead what has changed in cars from this day on, such as 2024-06-15.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Tell from each car's own drives how its sensors are off: no label, no log row is read.

    Offsets of gyroscope, accelerometer and steering, tyre radius, steering and understeer, each
    with its uncertainty and how fast it shrinks with drives. Needs the Gram rows of: **fleet-slip
    gram --features calibration**. SQL sees the same: **fleet-slip sql "FROM calibration"**

    Example: **fleet-slip calibrate**
    """
    day = date_of(since, "--since")
    found: Calibration = context.obj.calibrate(cohort)
    if car is not None:
        found.car(car)  # that there is such a car
    changed = [one for one in found.changed(day) if car in (None, one.car)] if day else []
    if json:
        shown = found.as_dict()
        if day:
            shown["changed"] = [vars(one) for one in changed]
        if car is not None:
            shown["cars"] = {car: shown["cars"][car]}
        print_json(shown)
    elif day:
        _print_changed(changed, day)
    elif car is not None:
        _print_car(car, found.car(car), found.evidence.refusals(car))
        _say_of_roads(found.roads)
    else:
        _print_fleet(found)
        _say_of_roads(found.roads)


def _print_car(
    car: str,
    numbers: Mapping[NumberName, CalibratedNumber],
    refusals: Mapping[NumberName, str],
) -> None:
    print_table(
        f"{car}, by its own drives",
        ["number", "unit", "value", "+-", "drives", "count on board", "of"],
        [
            [
                name,
                CAR_NUMBERS[name].unit,
                f"{one.value:.6g}",
                cell(one.uncertainty, ".2g"),
                str(one.drives),
                str(one.count),
                str(CAR_NUMBERS[name].grain),
            ]
            for name, one in numbers.items()
        ],
        left=2,
    )
    for reason in dict.fromkeys(refusals.values()):
        names = [name for name, why in refusals.items() if why == reason]
        say(f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} missing: {reason}")


def _print_fleet(found: Calibration) -> None:
    by_number = {
        name: [cars[name] for cars in found.cars.values() if name in cars] for name in CAR_NUMBERS
    }
    print_table(
        f"{number_of(len(found.cars), 'car')}, by their own drives",
        ["number", "unit", "cars", "median", "differs by", "known to +-"],
        [
            [
                name,
                CAR_NUMBERS[name].unit,
                f"{len(cars):,}",
                f"{median(one.value for one in cars):.3g}",
                f"{pstdev(one.value for one in cars):.2g}",
                cell(_median([one.uncertainty for one in cars]), ".2g"),
            ]
            for name, cars in by_number.items()
            if cars
        ],
        left=2,
    )
    if not any(one.uncertainty for cars in found.cars.values() for one in cars.values()):
        return say("no car has two drives: how sure the numbers are cannot be told")
    print_table(
        "\nhow sure after so many drives of a car; measured: by the next so many drives",
        ["number", "drives", "cars", "known to +-", "measured"],
        [
            [
                row.number,
                str(row.drives),
                f"{row.cars:,}",
                f"{row.stated:.2g}",
                cell(row.measured, ".2g"),
            ]
            for row in found.convergence()
        ],
    )


def _print_changed(changed: Sequence[ChangedNumber], since: date) -> None:
    if not changed:
        return say(f"no number of a car is another since {since}, as far as its drives tell")
    print_table(
        f"changed since {since}, by more than {SURE_ERRORS:g} standard errors",
        ["car", "number", "unit", "before", "after", "+-"],
        [
            [
                one.car,
                one.number,
                CAR_NUMBERS[one.number].unit,
                f"{one.before:.5g}",
                f"{one.after:.5g}",
                f"{one.uncertainty:.2g}",
            ]
            for one in changed
        ],
        left=3,
    )


def _say_of_roads(roads: Roads) -> None:
    if roads.hide_offsets:
        say(
            "bends look banked, and roads may always lean to one side, which fewer than "
            f"{FEWEST_CARS} cars with offsets cannot tell from their own: no car has ay_offset"
        )
    elif roads.banked and roads.lean:
        say(
            f"bends are banked, and the roads lean: {float(roads.lean):+.3f} m/s^2 +- "
            f"{roads.uncertainty:.2g} of ay in all {number_of(roads.cars, 'car')}, which ay_offset "
            "is without"
        )
    elif not roads.banked:
        say(
            "bends are seen not to be banked: a road that always leans to one side counts as "
            f"ay_offset. {FEWEST_CARS} cars or more tell the one from the other"
        )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None
