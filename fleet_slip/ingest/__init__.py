"""Ingests measured logs: a file and a mapping become counts at 100 Hz.

The processing of a row, in order:

1. `log_files` finds the logs of this machine: files, and those in folders. It refuses URLs.
2. `formats.reading` opens a file; its format yields batches of the columns that the mapping uses.
3. `time_bases` joins the time bases of a log; `log_rows` checks each row by itself:
   values in SI units, or the reason why it is refused.
4. `drives` checks the order of time and splits rows into drives, which `open_drives` collects until
   they end. `resampling` computes each drive's values at ticks, and `drives` their counts.
5. `stream` runs 2 to 4 for one log: it yields ended drives, keeps rejected rows, refuses a log
   without usable rows, and checks the log as a whole.
6. `load` processes batches of logs: `recordings` detects erased drives and duplicates, `load`
   writes data files and commits them.

A mapping (`mapping`, `columns`) assigns columns to signals.
"""
