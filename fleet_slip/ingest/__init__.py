"""Brings measured logs in: a file and a mapping become counts at 100 Hz.

The way of a row, in the order of its stations:

1. `log_files` finds the logs of this machine: files, and those in folders. It refuses URLs.
2. `formats.reading` opens a file; its format yields batches of the columns that the mapping uses.
3. `time_bases` joins the time bases of a log; `log_rows` checks each row by itself:
   values in SI units, or the reason why it is refused.
4. `drives` checks the order of time and cuts rows into drives, which wait in `open_drives` until
   they end; it brings each to ticks by `resampling`, and to counts.
5. `stream` goes through 2 to 4 for one log: it yields ended drives, keeps refused rows, refuses a
   log of which nothing is usable, and says what looks wrong in it as a whole, `suspicion` in a
   drive.
6. `load` goes through batches of logs: it leaves out what was forgotten or is in the logs already,
   as `recordings` says, writes data files, and commits them.

A mapping (`mapping`, of `columns`) says which column is which signal.
"""
