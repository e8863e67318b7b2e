"""What several tests, and some benchmarks, use: data, processes, servers, outside answers."""
