"""Drives of one car that overlap in time: a car drives once, so that their rows count twice.

A drive without a log began when its name says, and lasted as long as its rows: it has no more. Of
such a drive and a log that overlap it is named, since the log is what counts where both come; of
two drives without one the longer, since one message that covers a day must not accuse all others of
that day; of two logs the one that begins later.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.monitoring.plausibility import Fault

LEAST_S = 1.0
"""Clocks of two loggers differ by less."""

COLUMNS = ("vehicle_id", "started_at", "duration_s", "drive_id", "source", "n")


def find_repeated(drives: pa.Table) -> dict[str, Fault]:
    """Return what is wrong with each drive during which another one of its car was under way.

    `drives` has the columns of `COLUMNS`, a row or more for each drive; those whose time is not
    known are left out.
    """
    known = _timed(drives.select(COLUMNS))
    known = known.group_by(["vehicle_id", "drive_id"]).aggregate(
        [("start_s", "min"), ("lasted_s", "max"), ("counted_s", "sum"), ("received", "min")]
    )
    order = [(name, "ascending") for name in ("vehicle_id", "start_s_min", "drive_id")]
    found: dict[str, Fault] = {}
    longest: dict[str, Any] | None = None
    for row in _of_busy_cars(known.sort_by(order)).to_pylist():
        if longest is None or row["vehicle_id"] != longest["vehicle_id"]:
            longest = row
            continue
        common_s = min(_ends_s(longest), _ends_s(row)) - row["start_s_min"]
        earlier = common_s > LEAST_S and _is_suspect(longest, row)
        if common_s > LEAST_S:
            named, other = (longest, row) if earlier else (row, longest)
            figure = f"{common_s:.0f} s are in {other['drive_id']}"
            found.setdefault(named["drive_id"], Fault("repeated", (), figure))
        if earlier or _ends_s(row) > _ends_s(longest):
            longest = row
    return found


def _is_suspect(earlier: Mapping[str, Any], later: Mapping[str, Any]) -> bool:
    """Whether the earlier of two drives at once is named, not the later."""
    if not (earlier["received_min"] and later["received_min"]):
        return bool(earlier["received_min"])
    lasted_s = (_ends_s(drive) - drive["start_s_min"] for drive in (earlier, later))
    return bool(next(lasted_s) > next(lasted_s))


def _timed(drives: pa.Table) -> pa.Table:
    """Return when drives began and how long they lasted, of those that tell."""
    source, name = (drives[column].cast(pa.string()) for column in ("source", "drive_id"))
    received = pc.equal(source, RECEIVED)
    moment = pc.utf8_slice_codeunits(name, -16)
    said_s = pc.strptime(moment, "%Y%m%dT%H%M%SZ", "s", error_is_null=True).cast(pa.int64())
    logged_us = drives["started_at"].cast(pa.timestamp("us", tz="UTC")).cast(pa.int64())
    logged_s = pc.divide(logged_us.cast(pa.float64()), 1e6)
    start_s = pc.if_else(received, said_s.cast(pa.float64()), logged_s)
    counted_s = pc.multiply(drives["n"].cast(pa.float64()), float(SAMPLE_TIME_S))
    columns = {
        "vehicle_id": drives["vehicle_id"].cast(pa.string()),
        "drive_id": name,
        "start_s": start_s,
        "lasted_s": pc.coalesce(drives["duration_s"].cast(pa.float64()), 0.0),
        "counted_s": pc.if_else(received, counted_s, 0.0),
        "received": received,
    }
    return pa.table(columns).filter(start_s.is_valid())


def _of_busy_cars(drives: pa.Table) -> pa.Table:
    """Return the drives of cars of which one begins before the one before it has ended."""
    starts = drives["start_s_min"].to_numpy()
    ends = starts + np.maximum(
        drives["lasted_s_max"].to_numpy(), drives["counted_s_sum"].to_numpy()
    )
    cars = drives["vehicle_id"].combine_chunks().dictionary_encode()
    codes = cars.indices.to_numpy(zero_copy_only=False)
    busy = (codes[1:] == codes[:-1]) & (ends[:-1] - starts[1:] > LEAST_S)
    return drives.filter(pa.array(np.isin(codes, codes[1:][busy])))


def _ends_s(drive: Mapping[str, Any]) -> float:
    lasted_s: float = max(drive["lasted_s_max"], drive["counted_s_sum"])
    return float(drive["start_s_min"]) + lasted_s
