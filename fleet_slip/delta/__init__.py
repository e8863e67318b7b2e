"""The tables of a data root: Delta tables of Parquet files that we encode ourselves.

Files are written whole, durably, then committed. Names end in checksums of the bytes
(`fleet_slip.files.checksums`), which Delta log, checkpoints, Gram rows and listings keep: damage is
told years later, equal rows are equal files, and one made again needs no commit.
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
