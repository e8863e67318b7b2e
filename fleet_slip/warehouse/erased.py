"""Erased cars and drives that the tables name again, as after restoring an old backup.

The tables of a backup may be older than `forgotten/`. Views leave such rows out, so that no model
is trained on them; `status` reports them.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

import pyarrow.compute as pc

from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import StorageError
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.table import Snapshot, Table
from fleet_slip.warehouse.forgotten import Audit, Barred


def find_erased(
    root: Folder, grams: Table, snapshots: Sequence[Snapshot], *, ended: bool = False
) -> Barred:
    """Return the erased cars and drives that rows of some tables have.

    The table `grams` names the drives of most log files. A root without erasures costs one listing
    of the record's folder. `ended` leaves out erasures that are under way. An unreadable file is
    skipped: a query of its rows fails by itself.
    """
    audit = Audit(root)
    if not audit.begun():
        return Barred()
    if not any(snapshot.table == grams for snapshot in snapshots):
        with suppress(StorageError):
            snapshots = [grams.snapshot(), *snapshots]
    vehicles: set[str | None] = set()
    drives: set[str | None] = set()
    for vehicle_names, drive_names in _names_in(grams, snapshots):
        vehicles.update(vehicle_names)
        drives.update(drive_names)
    return audit.barred(
        {name for name in vehicles if name}, {name for name in drives if name}, ended=ended
    )


def without_erased(rows: str, erased: Barred) -> str:
    """Return the SQL of rows without those of erased cars and drives.

    Their names are the variables `erased_vehicle_id` and `erased_drive_id`.
    """
    predicates = [
        f"coalesce({column} NOT IN (SELECT unnest(getvariable('erased_{column}'))), true)"
        for column, names in names_by_column(erased).items()
        if names
    ]
    return f"(FROM {rows} WHERE {' AND '.join(predicates)})" if predicates else rows


def names_by_column(erased: Barred) -> dict[str, list[str]]:
    """Return the erased names, sorted, by the column that has them."""
    return {"vehicle_id": sorted(erased.vehicles), "drive_id": sorted(erased.drives)}


Names = Iterable[str | None]


def _names_in(grams: Table, snapshots: Sequence[Snapshot]) -> Iterator[tuple[Names, Names]]:
    """Yield the vehicles and drives of files. A log file with Gram rows is not opened."""
    counted: set[str] = set()
    for snapshot in sorted(snapshots, key=lambda snapshot: snapshot.table != grams):
        is_grams = snapshot.table == grams
        columns = ["vehicle_id", "drive_id", *(["feature_set", "file"] if is_grams else [])]
        for file in snapshot.files:
            if file.path in counted:
                continue
            with suppress(StorageError):
                rows = snapshot.table.read_combinations(file.path, columns)
                if is_grams:
                    plain = pc.equal(rows["feature_set"], PLAIN)
                    counted.update(rows["file"].filter(plain).to_pylist())
                yield rows["vehicle_id"].to_pylist(), rows["drive_id"].to_pylist()
