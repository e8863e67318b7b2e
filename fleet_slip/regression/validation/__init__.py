"""Cross-validation over folds of drives, and differences between models."""
