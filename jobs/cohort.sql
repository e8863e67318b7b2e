-- The Gram rows of a cohort. The condition may use any column of the view "drives".
-- Rows without any signal serve no model. Sorted, so that the same cohort reads the same everywhere.
SELECT
    drive_id, vehicle_id, vehicle_model, source, campaign, track, mass_kg, adhesion, speed_factor, saturated, day,
    started_at, duration_s,
    part, signals, n, clipped, sums, products, coalesce(trip, drive_id) AS trip
FROM grams
LEFT JOIN (
{trips}
) AS trips USING (drive_id)
WHERE feature_set = '{feature_set}' AND signals <> '' AND (
    {condition}
)
ORDER BY signals, drive_id, part
