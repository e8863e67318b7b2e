-- How many rows each car of a cohort has, and whether any of them came without a log.
SELECT vehicle_id, sum(n)::BIGINT AS n, bool_or(source = 'received') AS received
FROM grams
WHERE feature_set = '{feature_set}' AND signals <> '' AND vehicle_id IS NOT NULL AND (
    {condition}
)
GROUP BY vehicle_id
