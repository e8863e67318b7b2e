"""The catalog: signals, features, columns over time and feature sets."""
