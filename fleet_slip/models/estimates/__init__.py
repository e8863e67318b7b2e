"""Estimates of a published model: tick by tick, of data frames, of a cohort."""
