-- Delays that the Gram rows of a cohort were corrected for, by car, in quarters of a tick. Only rows with changes count.
SELECT
    vehicle_id,
    min(coalesce(course_delay_quarter_ticks, 0)) AS least,
    max(coalesce(course_delay_quarter_ticks, 0)) AS largest
FROM grams
WHERE feature_set = '{feature_set}' AND list_contains(string_split(signals, ','), '{turned}') AND (
    {predicate}
)
GROUP BY vehicle_id
ORDER BY vehicle_id
