-- The first of the Gram rows that cars counted whose drive is there already, and how it is called there: under any name, it
-- has the same counts. A drive that cars sent may come again with the rows of another feature set.
WITH stored AS (
    SELECT drive_id, feature_set, vehicle_id, day, signals, n, sums, products, starts_with(file, '{received}') AS received
    FROM read_parquet(getvariable('gram_files'), union_by_name => true)
    WHERE vehicle_id IN (SELECT vehicle_id FROM counted) OR drive_id IN (SELECT drive_id FROM counted)
)

SELECT number, counted.drive_id, stored.drive_id
FROM counted
JOIN stored ON stored.drive_id = counted.drive_id AND (NOT received OR stored.feature_set = counted.feature_set)
UNION ALL
SELECT number, counted.drive_id, stored.drive_id
FROM counted
JOIN stored USING (vehicle_id, day, feature_set, signals, n, sums, products)
WHERE feature_set = '{plain}'
ORDER BY 1
LIMIT 1
