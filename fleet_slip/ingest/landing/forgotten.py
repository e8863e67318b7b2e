"""Leaves out of a measured log what was forgotten: cars and drives that may not come back."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.warehouse.audit import Audit


@dataclass(frozen=True)
class KeptDrives:
    """Drives that may land.

    Attributes:
        vehicles: whose drives they are.
        left_out: how many may not land.
    """

    drives: tuple[MeasuredDrive, ...]
    vehicles: frozenset[str]
    left_out: int


def keep_drives(drives: Sequence[MeasuredDrive], audit: Audit) -> KeptDrives:
    """Return the drives that were not forgotten, nor their cars."""
    vehicles = {str(drive.metadata["vehicle_id"]) for drive in drives}
    barred = audit.barred(vehicles, {drive.drive_id for drive in drives})
    kept = tuple(
        drive
        for drive in drives
        if drive.drive_id not in barred.drives
        and str(drive.metadata["vehicle_id"]) not in barred.vehicles
    )
    there = frozenset(str(drive.metadata["vehicle_id"]) for drive in kept)
    return KeptDrives(kept, there, len(drives) - len(kept))


def keep_refused(
    refused: pa.Table, audit: Audit, drives: Collection[str] = ()
) -> tuple[pa.Table, frozenset[str]]:
    """Return the refused rows that may land, and whose they are; their file has these drives.

    A refused row goes with its car, or with the drive that it would have been of: the name of a
    drive that was cut at gaps in time begins with it.
    """
    vehicles, named = _names(refused, "vehicle_id"), _names(refused, "drive_id")
    barred = audit.barred(vehicles, named | set(drives))
    whole = {name for name in named if any(d.startswith(f"{name}-") for d in barred.drives)}
    kept = _without(refused, "vehicle_id", barred.vehicles)
    return _without(kept, "drive_id", barred.drives | whole), vehicles - barred.vehicles


def _names(rows: pa.Table, column: str) -> frozenset[str]:
    return frozenset(rows[column].unique().drop_null().cast(pa.string()).to_pylist())


def _without(rows: pa.Table, column: str, names: frozenset[str]) -> pa.Table:
    if not names:
        return rows
    unwanted = pc.is_in(rows[column].cast(pa.string()), pa.array(sorted(names), pa.string()))
    return rows.filter(pc.invert(pc.fill_null(unwanted, False)))
