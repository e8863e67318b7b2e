"""Which cars `calibrate --since` names that got other tyres, or sensors, in the middle of a month.

    python -m benchmarks.changed_cars [--campaigns fleet,fleet_realistic] [--cars 20] [--days 30]

After half of the days every fourth car has tyres that are 2 % smaller and 15 % softer, and the one
after it another sensor cluster. Printed is in how many cars of each kind any number changed, by
which numbers, when one asks for that day and for others.
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import fleet_slip
from benchmarks.calibration import small
from fleet_slip.catalogue.car_numbers import BY_COURSE, BY_SATELLITE, CALIBRATION
from fleet_slip.simulation.campaign import Campaign, DriveSpec

KINDS = ("other tyres", "another cluster", "nothing", "nothing")
"""What happens to a car, by its number."""
ASKED = (-10, -5, 0, 5, 10)
"""Days after that of the change."""


class ChangedCars(Campaign):
    """A campaign in the midst of which cars change."""

    @property
    def change(self) -> date:
        """The first day after it."""
        return self.first_day + timedelta(days=self.number_of_days // 2)

    def drives(self, day: date) -> tuple[DriveSpec, ...]:
        """Return the drives of a day."""
        specs = super().drives(day)
        return specs if day < self.change else tuple(map(changed, specs))


def kind_of(car: str) -> str:
    return KINDS[int(car.rsplit("-", 1)[1]) % len(KINDS)]


def changed(spec: DriveSpec) -> DriveSpec:
    """Return a drive of a car after what happened to it."""
    kind, car, sensors = kind_of(spec.vehicle_id), spec.vehicle, spec.sensors
    if kind == KINDS[0]:
        softer = car.with_tyres(stiffness_factor=0.85).tyre
        smaller = {"rolling_radius_m": 0.98 * softer.rolling_radius_m}
        tyre = softer.model_copy(update=smaller)
        return replace(spec, vehicle=car.model_copy(update={"tyre": tyre}))
    if kind == KINDS[1]:
        other = {
            "yaw_rate_bias_rad_s": sensors.yaw_rate_bias_rad_s + 0.004,
            "ay_bias_mps2": sensors.ay_bias_mps2 + 0.1,
        }
        return replace(spec, sensors=sensors.model_copy(update=other))
    return spec


def named(root: Path, campaign: ChangedCars) -> Mapping[int, Mapping[str, dict[str, set[str]]]]:
    """Return for each day that is asked for the numbers of the cars that are named, by kind."""
    fleet = fleet_slip.open(root)
    fleet.simulate(campaign)
    for name in (CALIBRATION, BY_SATELLITE, BY_COURSE) if campaign.receivers else (CALIBRATION,):
        fleet.gram(name)
    told = fleet.calibrate()
    found: dict[int, dict[str, dict[str, set[str]]]] = {}
    for late in ASKED:
        found[late] = {kind: {} for kind in KINDS}
        for one in told.changed(campaign.change + timedelta(days=late)):
            found[late][kind_of(one.car)].setdefault(one.car, set()).add(one.number)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", default="fleet,fleet_realistic,fleet_realistic_course")
    parser.add_argument("--cars", type=int, default=20)
    parser.add_argument("--days", type=int, default=30)
    options = parser.parse_args()
    for name in options.campaigns.split(","):
        usual = small(name, options.cars, None).model_copy(update={"number_of_days": options.days})
        campaign = ChangedCars.model_validate(usual.model_dump())
        with TemporaryDirectory() as folder:
            for late, kinds in named(Path(folder), campaign).items():
                for kind, cars in kinds.items():
                    numbers = ", ".join(sorted(set().union(*cars.values())))
                    print(f"{name}: {late:+d} days: {kind}: {len(cars)} cars {numbers}", flush=True)


if __name__ == "__main__":
    main()
