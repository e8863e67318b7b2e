"""Drives of one car that overlap in time: a car drives once, so that their rows count twice."""

from datetime import timedelta

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.monitoring.plausibility import Fault

LEAST_S = 1.0
"""Clocks of two loggers differ by less."""

COLUMNS = ("vehicle_id", "started_at", "duration_s", "drive_id")


def find_repeated(drives: pa.Table) -> dict[str, Fault]:
    """Return what is wrong with each drive during which another one of its car was under way.

    `drives` has the columns of `COLUMNS`, a row or more for each drive; those whose time is not
    known are left out. Of two drives the one that begins later is named, beside the other.
    """
    known = drives.select(COLUMNS).filter(pc.is_valid(drives["started_at"]))
    known = known.group_by(["vehicle_id", "drive_id"]).aggregate(
        [("started_at", "min"), ("duration_s", "max")]
    )
    order = [(name, "ascending") for name in ("vehicle_id", "started_at_min", "drive_id")]
    found: dict[str, Fault] = {}
    car = longest = None
    for row in known.sort_by(order).to_pylist():
        if row["vehicle_id"] != car:
            car, longest = row["vehicle_id"], None
        ends = row["started_at_min"] + timedelta(seconds=row["duration_s_max"] or 0)
        if longest is not None:
            other, until = longest
            common_s = (min(until, ends) - row["started_at_min"]).total_seconds()
            if common_s > LEAST_S:
                found[row["drive_id"]] = Fault("repeated", (), f"{common_s:.0f} s are in {other}")
        if longest is None or ends > longest[1]:
            longest = row["drive_id"], ends
    return found
