-- The log files that have a drive of a cohort, by the Gram rows of the logged signals.
-- The predicate may use any column of the view "drives".
SELECT DISTINCT file
FROM grams
WHERE feature_set = 'signals' AND NOT starts_with(file, 'received/') AND (
    {predicate}
)
