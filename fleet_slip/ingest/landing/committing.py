"""Commits what was written of a batch: refused rows, then drives."""

from collections.abc import Callable, Collection
from typing import Protocol

from fleet_slip.delta import Change, Snapshot, Unit, retry_conflicts
from fleet_slip.errors import ConflictError
from fleet_slip.ingest.landing.data_files import TableName
from fleet_slip.ingest.landing.landing import WrittenBatch, tables_of
from fleet_slip.ingest.landing.marks import KnownMarks, Origin
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse


class Superseding(Protocol):
    """Takes out of a table what gives way to new files, in the commit that lands these."""

    def without(self, name: TableName, snapshot: Snapshot, origins: Collection[Origin]) -> Change:
        """Return what takes drives, or their refused rows, out of a table; files are written."""
        ...


def land_batch(
    warehouse: Warehouse,
    written: WrittenBatch,
    write: Callable[[], WrittenBatch],
    note: dict[str, str],
    superseding: Superseding | None = None,
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit what was written of a batch; return it, and the units that are now in the logs.

    Where something was forgotten, or landed by another process, since it was written, `write`
    writes it again. Each table's files are one commit, with a note: refused rows, then drives; and
    what gives way to them goes in the same commits.
    """
    tables = tables_of(warehouse)

    def is_outdated(name: TableName, snapshot: Snapshot) -> bool:
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        if Audit(warehouse.root).begun() != written.forgotten:
            return True
        landed = snapshot.landed_among(len(written.parts[name].units))
        if any(landed(unit.name) for unit in written.parts[name].units):
            return True
        new = [one for one in written.outcomes if one.marks] if name == "logs" else []
        known = KnownMarks(snapshot.units if new else {})
        return any(known.find(one.marks) - one.found.origins for one in new)

    def commit(name: TableName) -> frozenset[str]:
        nonlocal written
        snapshot = tables[name].snapshot()
        while is_outdated(name, snapshot):
            for other, table in tables.items():
                table.discard(written.parts[other].files)
            written = write()
            snapshot = tables[name].snapshot()
        part = written.parts[name]
        gone = Change()
        if written.replaced and superseding and written.parts["logs"].files:
            gone = superseding.without(name, snapshot, written.replaced)
        marks = [mark for one in written.outcomes for mark in one.marks.items()]
        units = {unit.name: unit for unit in (*gone.units, *part.units)}
        if name == "logs":
            units |= {mark: Unit(mark, number) for mark, number in marks}
        if part.files or gone.remove:
            add = [*part.files, *gone.add]
            try:
                snapshot.commit(Change(add, gone.remove, tuple(units.values()), note))
            except ConflictError:
                tables[name].discard(gone.add)
                raise
        return frozenset(unit.name for unit in part.units) if part.files else frozenset()

    retry_conflicts(lambda: commit("quarantine"))
    new = retry_conflicts(lambda: commit("logs"))
    return written, new
