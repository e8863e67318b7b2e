"""Figures on a fleet: what a car's own numbers are worth, car by car."""

from collections.abc import Iterator

from fleet_slip.comparison.report.figures.cars import car_by_car
from fleet_slip.comparison.report.findings.cars import Cars
from fleet_slip.pages.picture import Picture
from fleet_slip.pages.text import count, degrees, percent


def fleet_pictures(cars: Cars | None) -> Iterator[Picture]:
    """Return the fleet car by car before and after calibration; none without a fleet."""
    if cars is None:
        return
    better = float((cars.after_deg < cars.before_deg).mean())
    title = "A fleet car by car, before and after calibration"
    caption = (
        f"{count(len(cars.before_deg))} cars of the campaign {cars.campaign}, each estimated by a "
        "model that was fitted on others. Root mean square error of all rows: "
        f"{degrees(cars.all_before_deg)} with {cars.inputs_before} inputs, "
        f"{degrees(cars.all_after_deg)} with {cars.inputs_after}, among them what the car's own "
        f"drives tell of its sensors and tyres without a label. {percent(better)} of the cars gain."
    )
    yield Picture(
        "fleet-cars",
        title,
        caption,
        f"{title}: two points for each car, in the order of the error without. {caption}",
        lambda size: car_by_car(cars, size),
    )
