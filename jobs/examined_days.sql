-- How many drives of a cohort there are on each day, and a hash that changes with any Gram row of theirs.
-- The predicate may use any column of the view "drives".
SELECT
    day,
    count(DISTINCT drive_id) FILTER (WHERE feature_set = 'signals') AS drives,
    bit_xor(hash(feature_set, drive_id, file, part, signals, n)) AS rows
FROM grams
WHERE signals <> '' AND (
    {predicate}
)
GROUP BY day
ORDER BY day
