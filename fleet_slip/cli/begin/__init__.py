"""The commands of the first minutes: run, sql, select, publish."""
