"""Gram rows: computed from log files, kept beside them, checked."""
