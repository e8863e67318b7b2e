"""Measured files of every format, read in batches of columns."""
