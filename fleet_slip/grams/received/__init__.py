"""Gram rows that cars send instead of logs."""
