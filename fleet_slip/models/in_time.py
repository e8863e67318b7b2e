"""Whether the course came in time: a late one looks like a side-slip angle, in all figures."""

from fleet_slip.catalogue.car_numbers import DELAY
from fleet_slip.errors import RefusedError
from fleet_slip.grams.cohorts.reader import open_grams
from fleet_slip.grams.rows.receiver_delay import ReceiverDelay, receiver_delays
from fleet_slip.models.manifest import Manifest
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

MOST_S, SURE_S = 0.01, 0.005
"""Delay, and standard error of it, that may be: 20 ms cost 0.4 deg on a real car."""
NAMED = 5


def require_in_time(warehouse: Warehouse, manifest: Manifest) -> dict[str, float]:
    """Return how late the receivers of the cars that taught a model are, in s.

    Raises `RefusedError` unless all are known to be in time.

    Raises `DataError` if the Gram rows that tell it are missing.
    """
    condition = parse_condition(manifest.trained_on.cohort)
    with open_grams(warehouse, DELAY, condition) as opened:
        delays = receiver_delays(opened.batches(condition))
    late = {car: one for car, one in delays.items() if not _in_time(one)}
    untold = (manifest.trained_on.vehicles or 0) - len(delays)
    if not late and untold <= 0:
        return {car: one.value for car, one in delays.items()}
    shown = ", ".join(f"{car} by {_said(one)}" for car, one in list(late.items())[:NAMED])
    more = f", and {len(late) - NAMED} more" if len(late) > NAMED else ""
    problems = [f"late: {shown}{more}"] if late else []
    if untold > 0:
        problems.append(f"{number_of(untold, 'car')} whose drives do not tell it")
    raise RefusedError(
        f"{manifest.name} was not published: not all receivers are known to be in time to "
        f"{1000 * MOST_S:g} ms ({'; '.join(problems)}). Give delay_s of the course in the mapping "
        "and ingest again, or choose other cars: the view calibration has the number "
        f"receiver_delay of each. To publish all the same: fleet-slip publish {manifest.name} "
        "--label course --force"
    )


def _in_time(one: ReceiverDelay) -> bool:
    sure = one.uncertainty is not None and one.uncertainty <= SURE_S
    return sure and abs(one.value) <= MOST_S


def _said(one: ReceiverDelay) -> str:
    if one.uncertainty is None:
        return f"{1000 * one.value:.0f} ms, of too few drives to be sure"
    return f"{1000 * one.value:.0f} +- {1000 * one.uncertainty:.0f} ms"
