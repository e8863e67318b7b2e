"""Takes drives out of the Gram rows that cars sent, which have no log to be written again."""

from collections.abc import Iterator, Sequence

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.delta import Change, TableFile, retry_conflicts
from fleet_slip.grams.rows.gram_files import read_rows, write_rows
from fleet_slip.grams.rows.gram_rows import is_received
from fleet_slip.maintenance.old_files import rows_of
from fleet_slip.warehouse.audit import Forgettable
from fleet_slip.warehouse.tables import Warehouse


def forget_received(warehouse: Warehouse, subject: Forgettable) -> int:
    """Commit the Gram rows without those of a subject that came without a log.

    Called after the fence, so that none lands any more. Returns how many rows of drives they were
    of. Raises `StorageError`, or `ConflictError`.
    """

    def attempt() -> int:
        snapshot = warehouse.grams.snapshot()
        concerned: list[TableFile] = []
        rows = 0
        for file in snapshot.files:
            told = warehouse.grams.read(file.path, ["file", "drive_id", "vehicle_id", "day", "n"])
            mine = pc.and_(rows_of(told, subject), is_received(told))
            if pc.any(mine).as_py():
                concerned.append(file)
                rows += pc.sum(told.filter(mine)["n"]).as_py()
        if concerned:
            add = write_rows(warehouse, _kept(warehouse, concerned, subject))
            snapshot.commit_or_discard(Change(add=add, remove=concerned, note={"job": "forget"}))
        return rows

    return retry_conflicts(attempt)


def _kept(
    warehouse: Warehouse, files: Sequence[TableFile], subject: Forgettable
) -> Iterator[pa.Table]:
    """Yield the Gram rows of files without those of a subject, file by file."""
    for file in files:
        rows = read_rows(warehouse.grams, file)
        yield rows.filter(pc.invert(pc.and_(rows_of(rows, subject), is_received(rows))))
