"""The commands for model versions."""
