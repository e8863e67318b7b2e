"""Takes drives out of the Gram rows that cars sent, which have no log to be written again."""

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.delta import Change, TableFile, retry_conflicts
from fleet_slip.grams.gram_files import read_rows, write_rows
from fleet_slip.grams.received_rows import is_received
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
        kept: list[pa.Table] = []
        concerned: list[TableFile] = []
        rows = 0
        for file in snapshot.files:
            every = read_rows(warehouse.grams, file)
            mine = pc.and_(rows_of(every, subject), is_received(every))
            if pc.any(mine).as_py():
                left = every.filter(pc.invert(mine))
                kept += [left] if left.num_rows else []
                concerned.append(file)
                rows += pc.sum(every.filter(mine)["n"]).as_py()
        if concerned:
            add = write_rows(warehouse, kept)
            snapshot.commit_or_discard(Change(add=add, remove=concerned, note={"job": "forget"}))
        return rows

    return retry_conflicts(attempt)
