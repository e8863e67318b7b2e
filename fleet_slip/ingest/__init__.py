"""Brings measured logs in: a file and a mapping become counts at 100 Hz.

The way of a row, in the order of its stations:

1. `formats.reading` opens the file. Its format yields batches of the columns that the mapping uses.
2. `log_rows` joins the parts of a log, leaves out rows that do not meet the conditions, and takes
   values in SI units, or the reason why a row is refused, by the expressions of `raw_columns`.
3. `drives` checks the order of time, cuts rows into drives, and brings each to ticks by
   `resampling`, and to counts.
4. `stream` goes through the steps above; it yields ended drives and refused rows, and refuses a
   file that came to nothing.
5. `load` leaves out what was forgotten and what is there already, and commits the files of a batch;
   `job` goes through all batches.
"""
