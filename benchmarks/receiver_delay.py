"""How well the delay of a receiver is told, and whether the uncertainty that is stated holds.

    python -m benchmarks.receiver_delay [--root FOLDER] [--cars 40] [--drives 30] [--seed 1]
        [--base fleet_realistic] [--types]

Simulates cars of a campaign with receivers that are 0 to 300 ms late, and asks for the delay after
the first few drives of each, and after all. What is told is the delay behind the accelerometer, of
which the latency and the low-pass are known here. A folder that is there is used again.

With --types, receivers are of three types, 20, 87 and 195 ms late, from which cars differ by up to
10 ms. A third of the cars has one drive, a third three, the others five, and what is told of them
with the type stands beside what each car alone tells.
"""

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Mapping
from datetime import timedelta
from itertools import cycle
from pathlib import Path

import numpy as np
import pyarrow as pa

import fleet_slip
from fleet_slip.catalogue.car_numbers import DELAY
from fleet_slip.grams.cohorts.gram_reader import open_grams
from fleet_slip.grams.rows.receiver_delay import (
    RECEIVER,
    ReceiverDelay,
    changed_delays,
    receiver_delays,
)
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.drive_plan import FleetPlan
from fleet_slip.simulation.imperfections import Range
from fleet_slip.simulation.sensing.receivers import Receiver, Receivers
from fleet_slip.warehouse.condition import parse_condition

STEPS = (1, 3, 10, 30)
"""Drives of each car that are asked."""
OF_TYPES = (1, 3, 5)
"""The same with types: of a third of the cars each."""
LARGE_S = 0.03
KEYS = ("vehicle_id", "day")
NINETY = 1.645
"""Standard errors that 90 % of normal errors are within."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, help="folder to simulate in; kept")
    parser.add_argument("--cars", type=int, default=40)
    parser.add_argument("--drives", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--base", default="fleet_realistic")
    parser.add_argument("--types", action="store_true")
    given = parser.parse_args()
    campaign = late_campaign(given.base, given.cars, given.drives, given.seed, types=given.types)
    with tempfile.TemporaryDirectory() as folder:
        fleet = fleet_slip.open(given.root or folder)
        fleet.simulate(campaign)
        for name in ("signals", DELAY):
            fleet.gram(name)
        if given.types:
            return print(*map(json.dumps, of_types(fleet, campaign)), sep="\n")
        for drives in (*(step for step in STEPS if step < given.drives), given.drives):
            print(json.dumps(measure(fleet, campaign, drives)), flush=True)
        for drives in (10, given.drives):
            print(json.dumps(changes(fleet, campaign, drives)), flush=True)


def late_campaign(base: str, cars: int, drives: int, seed: int, *, types: bool) -> Campaign:
    """Return a campaign in which each car drives once a day."""
    one = load_campaign(base)
    if not isinstance(one.plan, FleetPlan):
        raise SystemExit(f"{base} is no campaign of many cars")
    kinds = tuple(
        Receiver(
            name=f"{rate_hz} Hz" if types else None,
            delay_s=late_s if types else 0.0,
            rate_hz=rate_hz,
            velocity_std_mps=std_mps,
            wander_std_mps=std_mps,
            time_between_outages_s=60.0,
            outage_duration_s=5.0,
        )
        for rate_hz, std_mps, late_s in ((20, 0.02, 0.02), (10, 0.05, 0.087), (5, 0.1, 0.195))
    )
    tenth = Range(min=-0.1, max=0.1)
    late = Range(min=-0.01, max=0.01) if types else Range(min=0.0, max=0.3)
    return one.model_copy(
        update={
            "name": "receiver_delay",
            "seed": seed,
            "plan": one.plan.model_copy(update={"cars": cars}),
            "drives_per_day": cars,
            "number_of_days": drives,
            "receivers": Receivers(types=kinds, delay_error_s=late, antenna_error_m=tenth),
        }
    )


def of_types(fleet: fleet_slip.Fleet, campaign: Campaign) -> Iterator[dict[str, object]]:
    """Yield what cars of few drives tell alone, and with others of the type of their receiver."""
    drives = dict(zip(sorted(injected_s(campaign)), cycle(OF_TYPES)))
    last = {car: campaign.first_day + timedelta(days=some - 1) for car, some in drives.items()}
    batches = []
    for batch in gram_rows(fleet, "true"):
        keys = zip(*(batch[name].to_pylist() for name in KEYS), strict=True)
        batches.append(batch.filter(pa.array([day <= last[car] for car, day in keys])))
    alone = [_with(batch, RECEIVER, [None] * len(batch)) for batch in batches]
    for name, some in (("alone", alone), ("with the type", batches)):
        told = receiver_delays(some)
        for count in OF_TYPES:
            cars = {car: one for car, one in told.cars.items() if drives[car] == count}
            yield {"told": name, **judge(cars, campaign, count)}
    for name, pooled in told.types.items():
        figures = vars(pooled).items()
        yield {"type": name} | {k: round(v, 5) for k, v in figures if isinstance(v, float)}


def measure(fleet: fleet_slip.Fleet, campaign: Campaign, drives: int) -> dict[str, object]:
    """Return how far what the first drives of each car tell is from what was injected."""
    last = campaign.first_day + timedelta(days=drives - 1)
    told = receiver_delays(gram_rows(fleet, f"day <= '{last}'")).cars
    return judge(told, campaign, drives)


def gram_rows(fleet: fleet_slip.Fleet, cohort: str) -> list[pa.RecordBatch]:
    """Return the Gram rows that tell delays."""
    condition = parse_condition(cohort)
    with open_grams(fleet.warehouse, DELAY, condition) as opened:
        return list(opened.batches(condition))


def judge(told: Mapping[str, ReceiverDelay], campaign: Campaign, drives: int) -> dict[str, object]:
    """Return how far delays are from what was injected."""
    true = injected_s(campaign)
    cars = sorted(told)
    errors = np.array([told[car].value - true[car] for car in cars])
    stated = np.array([told[car].uncertainty or math.nan for car in cars])
    within = np.abs(errors) <= NINETY * stated
    return {
        "drives": drives,
        "cars": len(cars),
        "mean_ms": round(1000 * float(errors.mean()), 2),
        "rmse_ms": round(1000 * float(np.sqrt((errors**2).mean())), 2),
        "largest_ms": round(1000 * float(np.abs(errors).max()), 2),
        "within_5_ms": round(float((np.abs(errors) <= 0.005).mean()), 3),
        "stated_median_ms": round(1000 * float(np.median(stated)), 2),
        "within_1.645_stated": round(float(within.mean()), 3),
        "within_2_stated": round(float((np.abs(errors) <= 2 * stated).mean()), 3),
    }


def changes(fleet: fleet_slip.Fleet, campaign: Campaign, drives: int) -> dict[str, object]:
    """Return in how many cars a delay is said to have changed, and in how many where it has.

    It has in two cars of eight, whose first halves of the drives are exchanged.
    """
    last, middle = (campaign.first_day + timedelta(days=n) for n in (drives - 1, drives // 2))
    batches = gram_rows(fleet, f"day <= '{last}'")
    true, names = injected_s(campaign), sorted(injected_s(campaign))
    following = dict(zip(names[::8], names[1::8], strict=False))
    following |= {other: one for one, other in following.items()}
    by = np.array([abs(true[one] - true[other]) for one, other in following.items()])
    joined = []
    for batch in batches:
        keys = zip(*(batch[name].to_pylist() for name in KEYS), strict=True)
        cars = [following.get(car, car) if day < middle else car for car, day in keys]
        joined.append(_with(batch, "vehicle_id", cars))
    told = changed_delays(joined)
    found = np.array([one in told for one in following])
    return {
        "drives": drives,
        "cars": len(names),
        "false_alarms": len(changed_delays(batches)),
        "changed_by_30_ms": int((by >= LARGE_S).sum()),
        "of_these_found": int(found[by >= LARGE_S].sum()),
    }


def _with(batch: pa.RecordBatch, column: str, values: list[str | None]) -> pa.RecordBatch:
    """Return Gram rows with other values in a column of names."""
    place = batch.schema.get_field_index(column)
    return batch.set_column(place, column, pa.array(values, pa.string()))


def injected_s(campaign: Campaign) -> dict[str, float]:
    """Return the delay of each car's receiver behind its accelerometer, s."""
    found = {}
    for one in campaign.drives(campaign.first_day):
        sensors = one.flaws.sensors if one.flaws else None
        behind = sensors.inertial_latency_s if sensors else 0.0
        if sensors and sensors.inertial_bandwidth_hz:
            behind += 1 / (2 * math.pi * sensors.inertial_bandwidth_hz)
        found[one.vehicle_id] = (one.receiver.delay_s if one.receiver else 0.0) - behind
    return found


if __name__ == "__main__":
    main()
