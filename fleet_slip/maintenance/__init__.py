"""Keeping a warehouse whole: verify, repair, compact, vacuum, forget, retain, migrate."""
