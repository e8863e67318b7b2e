"""Ingests measured logs: a file and a mapping become counts at 100 Hz.

The processing of a row, one module a step, in this order:

1. `log_files` finds the logs of this machine: files, and those in folders. It refuses URLs, and
   makes one log of several files of a drive.
2. `batches` reads a file in bounded batches of the columns that the mapping uses, by the reader of
   its format (`formats`); several time bases become one table.
3. `checked_columns` checks each row by itself: converts it to SI units, or rejects it with a
   reason.
4. `drives` checks the order of time, splits rows into drives, and collects them until they end.
5. `ticks` resamples a drive to 100 Hz and rounds its signals to counts.
6. `logs` processes batches of logs: `recordings` detects erased drives and duplicates, `logs`
   writes data files and commits them.

`measured_log` runs 2 to 5 for one log: it yields ended drives, keeps rejected rows, refuses a log
without usable rows, and checks the log as a whole. A mapping (`mapping`, `columns`) assigns columns
to signals; `profile`, `guess` and `draft` propose one.
"""
