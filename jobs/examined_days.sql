-- Number of drives of a cohort on each day, and a hash that changes with any of their Gram rows.
-- The predicate may use any column of the view "drives".
SELECT
    day,
    count(DISTINCT drive_id) FILTER (WHERE feature_set = 'signals') AS drives,
    bit_xor(hash(feature_set, drive_id, file, block, signals, row_count)) AS rows
FROM grams
WHERE signals <> '' AND (
    {predicate}
)
GROUP BY day
ORDER BY day
