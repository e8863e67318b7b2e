"""Estimates other than least squares: Pace, ridge, errors in variables."""
