"""What of a file may land: all but the drives and the cars that were forgotten."""

from collections.abc import Collection, Sequence

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.warehouse.audit import Audit


def keep_drives(drives: Sequence[MeasuredDrive], audit: Audit) -> list[MeasuredDrive]:
    """Return the drives that were not forgotten under any name, nor their cars."""
    barred = audit.barred(set(map(car_of, drives)), {drive.drive_id for drive in drives})
    counts = audit.barred_counts()
    return [
        drive
        for drive in drives
        if drive.drive_id not in barred.drives
        and car_of(drive) not in barred.vehicles
        and not (counts and drive.counts_digest in counts)
    ]


def keep_refused(refused: pa.Table, audit: Audit, left_out: Collection[str] = ()) -> pa.Table:
    """Return the refused rows that may land, where some drives of their file may not.

    A refused row goes with its car, or with the drive that it would have been of: the name of a
    drive that was cut at gaps in time begins with it.
    """
    vehicles, named = names_in(refused, "vehicle_id"), names_in(refused, "drive_id")
    barred = audit.barred(vehicles, named)
    drives = barred.drives | set(left_out)
    whole = {name for name in named if any(drive.startswith(f"{name}-") for drive in drives)}
    for column, unwanted in (("vehicle_id", barred.vehicles), ("drive_id", drives | whole)):
        if unwanted:
            names = pa.array(sorted(unwanted), pa.string())
            mine = pc.is_in(refused[column].cast(pa.string()), names)
            refused = refused.filter(pc.invert(pc.fill_null(mine, False)))
    return refused


def car_of(drive: MeasuredDrive) -> str:
    """Return the name of the car of a drive."""
    return str(drive.metadata["vehicle_id"])


def names_in(rows: pa.Table, column: str) -> frozenset[str]:
    """Return the names that stand in a column of rows."""
    return frozenset(rows[column].unique().drop_null().cast(pa.string()).to_pylist())
