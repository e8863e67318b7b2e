-- The drives of a cohort whose cars sent Gram rows of the logged signals, and no log.
-- The condition may use any column of the view "drives".
SELECT count(DISTINCT drive_id)
FROM grams
WHERE feature_set = 'signals' AND starts_with(file, 'received/') AND (
    {condition}
)
