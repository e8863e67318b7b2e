"""Takes drives out of the logs that others replace, or that somebody withdraws.

They may come again: their files' units are withdrawn. Their Gram rows go with the files.
"""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import PurePath

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.delta import Change, Snapshot, Unit, retry_conflicts
from fleet_slip.errors import ConflictError
from fleet_slip.ingest.landing.data_files import TableName
from fleet_slip.ingest.landing.known_files import WITHDRAWALS
from fleet_slip.ingest.landing.marks import MEASURED, KnownMarks, Origin
from fleet_slip.ingest.landing.same_recordings import is_from
from fleet_slip.maintenance.rewriting import Rewriting, rewriting_units, write_again, write_without
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class TakingOut:
    """Takes the drives of some origins out of the tables of a data root."""

    warehouse: Warehouse

    def without(self, name: TableName, snapshot: Snapshot, origins: Collection[Origin]) -> Change:
        """Return the change that takes the drives, or refused rows, of origins out."""
        if name == "quarantine":
            return self._without_refused(snapshot, origins)
        drives = drives_in(self.warehouse, snapshot)
        gone = {p: {one for one in there if is_from(one, origins)} for p, there in drives.items()}
        left = {Origin.of_drive(one) for p, there in drives.items() for one in there - gone[p]}
        files = {one.file for one in origins} - {one.file for one in left if one}
        units = KnownMarks(snapshot.units).withdraw(origins, files)
        concerned = [file for file in snapshot.files if gone.get(file.path)]
        if concerned:
            units += rewriting_units(snapshot, concerned)
            units.append(Unit(WITHDRAWALS, (snapshot.version or 0) + 1))
        kept = [Rewriting("kept", [file], gone[file.path]) for file in concerned]
        return Change(write_again(self.warehouse, snapshot, kept), concerned, units)

    def _without_refused(self, snapshot: Snapshot, origins: Collection[Origin]) -> Change:
        def mine(rows: pa.Table) -> pa.ChunkedArray:
            names = rows["drive_id"].cast(pa.string())
            some = [n for n in names.unique().drop_null().to_pylist() if is_from(n, origins)]
            return pc.fill_null(pc.is_in(names, pa.array(some, pa.string())), False)

        add, remove = write_without(snapshot, mine)
        files = {one for one in origins if one == one.file}
        return Change(add, remove, KnownMarks(snapshot.units).withdraw((), files))


def drives_in(warehouse: Warehouse, logs: Snapshot) -> dict[str, set[str]]:
    """Return the drives of each log file, opening only files without Gram rows."""
    grams, identity = warehouse.grams.snapshot(), features().identity(PLAIN)
    found: dict[str, set[str]] = {}
    for file in grams.files:
        rows = grams.table.read(file.path, ["feature_set", "file", "drive_id"])
        rows = rows.filter(pc.equal(rows["feature_set"], identity)).drop_columns("feature_set")
        for row in rows.to_pylist():
            found.setdefault(row["file"], set()).add(row["drive_id"])
    return {
        file.path: found.get(file.path) or set(logs.table.read_names(file.path)["drive_id"].used)
        for file in logs.files
    }


def take_back(warehouse: Warehouse, what: str) -> int:
    """Take out what was ingested from a file, or through a mapping; return how many drives.

    `what` names either, or begins the names of a file's drives. All of it goes that is there at the
    commit, whoever replaces it meanwhile.
    """
    taking_out = TakingOut(warehouse)

    def attempt() -> int:
        logs = warehouse.logs.snapshot()
        drives = _drives_called(warehouse, what)
        if warehouse.logs.snapshot().version != logs.version:
            raise ConflictError(f"{warehouse.root}: the logs keep changing. Run it again.")
        origins = {origin.file for drive in drives if (origin := Origin.of_drive(drive))}
        refused = warehouse.quarantine.snapshot()
        changes: dict[TableName, Snapshot] = {"quarantine": refused, "logs": logs}
        for name, snapshot in changes.items() if drives else ():
            gone = taking_out.without(name, snapshot, origins)
            if gone.remove or gone.units:
                change = Change(gone.add, gone.remove, gone.units, {"job": "undo"})
                snapshot.commit_or_discard(change)
        return len(drives)

    return retry_conflicts(attempt)


def _drives_called(warehouse: Warehouse, what: str) -> list[str]:
    query = (
        "SELECT drive_id FROM drives WHERE regexp_matches(drive_id, $measured) AND (source_file = "
        "$file OR starts_with(drive_id, $what || '-') OR regexp_replace(drive_id, $measured, '') "
        "= $what) ORDER BY ALL"
    )
    given = {"measured": MEASURED, "file": PurePath(what).name, "what": what}
    with connect_tables(warehouse, query) as database:
        return [drive for (drive,) in database.execute(query, given).fetchall()]
