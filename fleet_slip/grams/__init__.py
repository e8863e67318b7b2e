"""From log rows to Gram rows, and from Gram rows to the sums of cohorts and folds."""
