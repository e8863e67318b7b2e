"""Evaluation of estimators on test drives: what they see, how far they are off, and where."""
