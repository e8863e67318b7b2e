"""The tables of a data root: Delta tables of Parquet files that we encode ourselves.

A file is written as a whole, durably; only then is it committed to the table's Delta log. So a
reader sees whole files of whole commits, or nothing.

A file's name ends in the checksums of its bytes (`fleet_slip.files.checksums`). The name is the one
thing about a file that the Delta log, its checkpoints, Gram rows and a listing of the folder all
keep, so that damage can be told years later; the same rows are always the same file; and a file
that is made again from its source takes its place without a commit.
"""

from fleet_slip.delta.change import Change, TableFile, Unit, absent_columns, rows_in
from fleet_slip.delta.conflicts import on_newest, retry_conflicts
from fleet_slip.delta.encoding import Encoded, Encoding
from fleet_slip.delta.snapshot import WITHDRAWN, Snapshot
from fleet_slip.delta.table import Table
from fleet_slip.files.checksums import checksum_in, checksum_of

__all__ = [
    "WITHDRAWN",
    "Change",
    "Encoded",
    "Encoding",
    "Snapshot",
    "Table",
    "TableFile",
    "Unit",
    "absent_columns",
    "checksum_in",
    "checksum_of",
    "on_newest",
    "retry_conflicts",
    "rows_in",
]
