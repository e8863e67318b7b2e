"""Keeping a warehouse in service: history of runs, health, data quality, drift."""
