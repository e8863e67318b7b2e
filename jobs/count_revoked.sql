-- The drives of a cohort that a revoked key signed, by car.
SELECT
    vehicle_id,
    count(DISTINCT drive_id) AS drives
FROM grams
WHERE feature_set = 'signals' AND (
    {condition}
)
GROUP BY vehicle_id
ORDER BY vehicle_id
