"""Shared code of tests and benchmarks: data, processes, servers, outside answers."""
