-- The first Gram row from a car with which the drives of a day, including the stored ones, have more than ? rows: 24 hours.
WITH stored AS (
    SELECT vehicle_id, day, feature_set, part, sum(n) AS stored_n
    FROM read_parquet(getvariable('gram_files'), union_by_name => true)
    WHERE vehicle_id IN (SELECT vehicle_id FROM counted)
    GROUP BY ALL
),

driven AS (
    SELECT
        number,
        drive_id,
        coalesce(stored_n, 0) + sum(n) OVER (
            PARTITION BY counted.vehicle_id, counted.day, counted.feature_set, counted.part ORDER BY number
        ) AS total
    FROM counted
    LEFT JOIN stored ON
        stored.part IS NOT DISTINCT FROM counted.part
        AND (stored.vehicle_id, stored.day, stored.feature_set)
        = (counted.vehicle_id, counted.day, counted.feature_set)
)

SELECT number, drive_id
FROM driven
WHERE total > ?
ORDER BY number
LIMIT 1
