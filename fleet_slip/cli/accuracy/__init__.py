"""The commands that tell how good a model is."""
