-- The first Gram row from a car whose drive is stored already, and the stored name of the drive. A stored drive has the same
-- name, or the same counts under any name, car or day. Rows with little variation (not `is_eventful`) must also have the same
-- car and day. A drive from a car may have further rows of other feature sets.
WITH stored AS (
    SELECT drive_id, feature_set, part, vehicle_id, day, signals, n, sums, products, starts_with(file, '{received}') AS received
    FROM read_parquet(getvariable('gram_files'), union_by_name => true)
    WHERE n IN (SELECT n FROM counted) OR drive_id IN (SELECT drive_id FROM counted)
)

SELECT number, counted.drive_id, stored.drive_id
FROM counted
JOIN stored ON stored.drive_id = counted.drive_id AND (NOT received OR stored.feature_set = counted.feature_set)
UNION ALL
SELECT number, counted.drive_id, stored.drive_id
FROM counted
JOIN stored USING (feature_set, signals, n, sums, products)
WHERE
    counted.part IS NOT DISTINCT FROM stored.part
    AND (is_eventful OR (counted.vehicle_id, counted.day) = (stored.vehicle_id, stored.day))
ORDER BY 1
LIMIT 1
