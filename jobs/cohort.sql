-- The Gram rows of a cohort, in any order. The predicate may use any column of the view "drives".
-- Rows without any signal serve no model. A hash is the first 8 bytes of the SHA-256 of a name.
SELECT
    drive_id, vehicle_id, vehicle_model, {receiver}, source, campaign, track, mass_kg, adhesion, speed_factor, saturated,
    day, started_at, duration_s,
    block AS part, signals, row_count AS n, clipped, sums, products, coalesce(trip, drive_id) AS trip,
    ('0x' || left(sha256(drive_id), 16))::UBIGINT AS drive_hash,
    ('0x' || left(sha256(coalesce(vehicle_id, '')), 16))::UBIGINT AS vehicle_hash,
    ('0x' || left(sha256(coalesce(trip, drive_id)), 16))::UBIGINT AS trip_hash
FROM grams
LEFT JOIN (
{trips}
) AS trips USING (drive_id)
WHERE feature_set = '{feature_set}' AND signals <> '' AND (
    {predicate}
)
