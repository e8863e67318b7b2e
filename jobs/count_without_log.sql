-- The drives of a cohort whose cars sent Gram rows of the logged signals, and no log, nor Gram rows of the feature set.
-- The predicate may use any column of the view "drives".
SELECT count(DISTINCT drive_id)
FROM grams
WHERE feature_set = 'signals' AND starts_with(file, 'received/') AND (
    {predicate}
)
AND drive_id NOT IN (
    SELECT drive_id FROM grams WHERE feature_set = '{feature_set}' AND starts_with(file, 'received/')
)
