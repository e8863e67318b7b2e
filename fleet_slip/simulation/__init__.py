"""Simulated drives: campaigns, tracks, sensors, and the job that writes what is missing."""
