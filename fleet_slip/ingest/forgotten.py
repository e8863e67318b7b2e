"""Leaves out of a measured log what was forgotten: cars and drives that may not come back."""

from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.delta import only_used_values
from fleet_slip.warehouse.audit import Audit


@dataclass(frozen=True)
class KeptRows:
    """What of a measured log may land.

    Attributes:
        logs, quarantine: its rows.
        vehicles, drives: whose rows these are.
        left_out: drives that may not land.
    """

    logs: pa.Table
    quarantine: pa.Table
    vehicles: frozenset[str]
    drives: frozenset[str]
    left_out: int


def without_forgotten(
    logs: pa.Table, quarantine: pa.Table, audit: Audit, others: frozenset[str] = frozenset()
) -> KeptRows:
    """Return what of the rows of a measured log may land; it has also drives that are not there.

    A refused row goes with its car, or with the drive that it would have been of: the name of a
    drive that was cut at gaps in time begins with it.
    """
    there = _names(logs, "drive_id")
    vehicles = _names(logs, "vehicle_id") | _names(quarantine, "vehicle_id")
    drives = there | _names(quarantine, "drive_id")
    barred = audit.barred(vehicles, drives | others)
    whole = {name for name in drives if any(d.startswith(f"{name}-") for d in barred.drives)}
    logs = _without(_without(logs, "vehicle_id", barred.vehicles), "drive_id", barred.drives)
    refused = _without(quarantine, "vehicle_id", barred.vehicles)
    refused = _without(refused, "drive_id", barred.drives | whole)
    return KeptRows(
        logs,
        refused,
        vehicles - barred.vehicles,
        drives - barred.drives - whole,
        len(there - _names(logs, "drive_id")) if barred else 0,
    )


def _names(rows: pa.Table, column: str) -> frozenset[str]:
    return frozenset(rows[column].unique().drop_null().cast(pa.string()).to_pylist())


def _without(rows: pa.Table, column: str, names: frozenset[str]) -> pa.Table:
    if not names:
        return rows
    unwanted = pc.is_in(rows[column].cast(pa.string()), pa.array(sorted(names), pa.string()))
    return only_used_values(rows.filter(pc.invert(pc.fill_null(unwanted, False))))
