"""Simulated drives: campaigns, roads, traffic, sensors, and the simulation of logs."""
