-- The delays that the Gram rows of a cohort's cars were corrected by, in parts of a tick. A row without changes tells none.
SELECT
    vehicle_id,
    min(coalesce(course_late, 0)) AS least,
    max(coalesce(course_late, 0)) AS largest
FROM grams
WHERE feature_set = '{feature_set}' AND list_contains(string_split(signals, ','), '{turned}') AND (
    {predicate}
)
GROUP BY vehicle_id
ORDER BY vehicle_id
