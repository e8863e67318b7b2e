"""Leaves out of a measured log what was forgotten: cars and drives that may not come back."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.counts import as_arrow
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.recordings import Recording, record_drive


@dataclass(frozen=True)
class KeptDrives:
    """Drives that may land.

    Attributes:
        vehicles: whose drives they are.
        left_out: the names of those that may not land.
    """

    drives: tuple[MeasuredDrive, ...]
    vehicles: frozenset[str]
    left_out: frozenset[str]


def keep_drives(drives: Sequence[MeasuredDrive], audit: Audit) -> KeptDrives:
    """Return the drives that were not forgotten under any name, nor their cars."""
    barred = audit.barred(set(map(_car_of, drives)), {drive.drive_id for drive in drives})
    known = audit.recordings()
    left_out = frozenset(
        drive.drive_id
        for drive in drives
        if drive.drive_id in barred.drives
        or _car_of(drive) in barred.vehicles
        or (known is not None and known.has(_recording_of(drive)))
    )
    kept = tuple(drive for drive in drives if drive.drive_id not in left_out)
    return KeptDrives(kept, frozenset(map(_car_of, kept)), left_out)


def keep_refused(
    refused: pa.Table, audit: Audit, left_out: Collection[str] = ()
) -> tuple[pa.Table, frozenset[str]]:
    """Return the refused rows that may land, and whose they are; drives of their file may not.

    A refused row goes with its car, or with the drive that it would have been of: the name of a
    drive that was cut at gaps in time begins with it.
    """
    vehicles, named = _names(refused, "vehicle_id"), _names(refused, "drive_id")
    barred = audit.barred(vehicles, named)
    drives = barred.drives | set(left_out)
    whole = {name for name in named if any(drive.startswith(f"{name}-") for drive in drives)}
    kept = _without(refused, "vehicle_id", barred.vehicles)
    return _without(kept, "drive_id", drives | whole), vehicles - barred.vehicles


def _car_of(drive: MeasuredDrive) -> str:
    return str(drive.metadata["vehicle_id"])


def _recording_of(drive: MeasuredDrive) -> Recording:
    ticks = as_arrow(drive.ticks)
    return record_drive(_car_of(drive), str(drive.metadata["day"]), ticks, drive.counts)


def _names(rows: pa.Table, column: str) -> frozenset[str]:
    return frozenset(rows[column].unique().drop_null().cast(pa.string()).to_pylist())


def _without(rows: pa.Table, column: str, names: frozenset[str]) -> pa.Table:
    if not names:
        return rows
    unwanted = pc.is_in(rows[column].cast(pa.string()), pa.array(sorted(names), pa.string()))
    return rows.filter(pc.invert(pc.fill_null(unwanted, False)))
