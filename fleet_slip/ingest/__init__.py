"""Brings measured logs in: a file and a mapping become counts at 100 Hz.

The way of a row, in the order of its stations:

1. `formats.reading` opens the file. Its format yields batches of the columns that the mapping uses.
2. `drives.log_rows` joins the parts of a log, and `drives.time_bases` its time bases.
3. `drives.checking` leaves out rows that do not meet the conditions. Of the others it takes values
   in SI units, or the reason why the row is refused, by the expressions of `drives.fields`.
4. `drives.drive_cutter` checks the order of time and cuts rows into parts of drives.
5. `drives.open_drives` keeps the rows of a part until it has ended.
6. `drives.measured_drives` brings a drive to ticks, by `drives.resampling`, and to counts.
7. `drives.stream` goes through the steps above; it yields ended drives and refused rows.
   `drives.file_totals` counts what became of all rows, and refuses a file that came to nothing.
8. `landing.landing` leaves out what was forgotten, by `landing.allowed_rows`, passes the rest on to
   `landing.data_files`, and commits the files of a batch; `landing.ingest_job` goes through all
   batches.
"""

from fleet_slip.ingest.drives.file_totals import IngestCounts
from fleet_slip.ingest.mapping.mapping import Mapping, load_mapping

__all__ = [
    "IngestCounts",
    "Mapping",
    "load_mapping",
]
