"""Hostile and broken input, made by mutation. `benchmarks.fuzz` takes its time with it."""
