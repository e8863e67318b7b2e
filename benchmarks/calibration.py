"""How far off the numbers are that a car's drives tell, and whether their uncertainty holds.

    python -m benchmarks.calibration [--root FOLDER] [--campaign fleet_realistic] [--cars 60]
        [--tracks country,hill] [--days 7]

Simulates 30 drives of each car of a campaign and asks for its numbers after 1, 5 and 30: the error
against what the simulator knows, its standard deviation, the share of cars within two stated
errors, and cars without the number. The road's lean counts as an error. `--tracks` puts the cars on
eight drawn roads of each class. `--days` takes the first days of the campaign as it is instead, and
asks for the numbers by all drives. A folder that is there is used again.
"""

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import fleet_slip
from fleet_slip.catalogue.car_numbers import BY_COURSE, BY_SATELLITE, CALIBRATION, CAR_NUMBERS
from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.grams.calibration.car_evidence import CarEvidence
from fleet_slip.simulation.campaign import Campaign, DriveSpec, load_campaign
from fleet_slip.simulation.roads import load_track
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

STEPS = (1, 5, 30)
ROADS = 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, help="folder to simulate in; kept")
    parser.add_argument("--campaign", default="fleet_realistic")
    parser.add_argument("--cars", type=int, default=60)
    parser.add_argument("--tracks", help="classes of roads, such as country,hill")
    parser.add_argument("--days", type=int, help="of the campaign with all of its cars")
    given = parser.parse_args()
    if given.days:
        usual = load_campaign(given.campaign)
        campaign = usual.model_copy(update={"number_of_days": given.days})
    else:
        campaign = small(given.campaign, given.cars, given.tracks)
    with tempfile.TemporaryDirectory() as temporary:
        evidence = evidence_of(given.root or Path(temporary), campaign)
    for line in figures(evidence, truth(campaign), (None,) if given.days else STEPS):
        print(json.dumps(line), flush=True)


def small(name: str, cars: int, tracks: str | None) -> Campaign:
    """Return a campaign with so many cars, each of which drives once a day."""
    usual = load_campaign(name)
    plan = usual.plan.model_copy(update={"cars": cars})
    if tracks:
        roads = [load_track(f"{kind}_{i}") for kind in tracks.split(",") for i in range(ROADS)]
        plan = plan.model_copy(update={"tracks": tuple(roads)})
    changes = {"plan": plan, "drives_per_day": cars, "number_of_days": STEPS[-1]}
    return usual.model_copy(update=changes)


def evidence_of(root: Path, campaign: Campaign) -> CarEvidence:
    """Simulate what is missing, and return what the drives are evidence of."""
    fleet = fleet_slip.open(root)
    fleet.simulate(campaign)
    sets = (CALIBRATION, BY_SATELLITE, BY_COURSE) if campaign.receivers else (CALIBRATION,)
    for name in sets:
        fleet.gram(name)
    return fleet.calibrate(ALL_DRIVES).evidence


def truth(campaign: Campaign) -> dict[str, dict[str, float]]:
    """Return what the simulator knows of each car's numbers, by car."""
    return {
        spec.vehicle_id: _true(spec) for day in campaign.days() for spec in campaign.drives(day)
    }


def _true(spec: DriveSpec) -> dict[str, float]:
    sensors, car = spec.flaws.sensors, spec.flaws.car
    lean_mps2 = GRAVITY_MPS2 * math.sin(math.radians(sensors.inertial_roll_deg))
    wheels_deg = (sensors.wheel_angle_offset_fl_deg + sensors.wheel_angle_offset_fr_deg) / 2
    radii = (car.radius_error_fl, car.radius_error_fr, car.radius_error_rl, car.radius_error_rr)
    return {
        "yaw_rate_offset": spec.sensors.yaw_rate_bias_rad_s,
        "yaw_rate_offset_by_wheels": spec.sensors.yaw_rate_bias_rad_s,
        "ay_offset": spec.sensors.ay_bias_mps2 + lean_mps2,
        "steering_offset": math.radians(wheels_deg + car.thrust_angle_deg),
        "speed_ratio": spec.vehicle.tyre.rolling_radius_m / 0.31 * (1 + sum(radii) / 4),
    }


def figures(
    evidence: CarEvidence,
    known: dict[str, dict[str, float]],
    steps: Sequence[int | None] = STEPS,
) -> Iterator[dict[str, object]]:
    """Yield how far off each number is after so many drives; None: after all."""
    roads = evidence.roads
    lean = None if roads.lean is None else round(float(roads.lean), 4)
    yield {"banked": roads.banked, "lean_mps2": lean, "of_cars": roads.cars}
    for step in steps:
        told = {car: evidence.calibrated(car, drives=step) for car in evidence.cars}
        for name in CAR_NUMBERS:
            pairs = [
                (one[name].value - known[car][name], one[name].uncertainty)
                for car, one in told.items()
                if name in one and name in known[car]
            ]
            if not pairs:
                continue
            errors = np.array([error for error, _ in pairs])
            stated = np.array([math.nan if u is None else u for _, u in pairs])
            yield {
                "drives": step,
                "number": name,
                "mean_error": round(float(errors.mean()), 5),
                "std": round(float(errors.std()), 5),
                "stated": round(float(np.median(stated)), 5),
                "within_two": round(float(np.mean(np.abs(errors) < 2 * stated)), 3),
                "cars_without": len(told) - len(pairs),
            }


if __name__ == "__main__":
    main()
