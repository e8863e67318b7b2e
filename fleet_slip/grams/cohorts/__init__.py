"""From Gram rows to the sums of cohorts, folds, days and cars."""
