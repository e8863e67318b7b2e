-- The Gram rows of a cohort with what their fold is told from, in any order: only their sums are of interest.
-- The condition may use any column of the view "drives". Rows without any signal serve no model.
SELECT
    drive_id, vehicle_id, {receiver}, source, track, mass_kg, adhesion, speed_factor, day, part, signals, n, sums, products,
    coalesce(trip, drive_id) AS trip
FROM grams
LEFT JOIN (
{trips}
) AS trips USING (drive_id)
WHERE feature_set = '{feature_set}' AND signals <> '' AND (
    {condition}
)
