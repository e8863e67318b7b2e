-- The drives that share a trip with others: pieces of one drive, in one file or in several, between which the car stood
-- for {longest_pause_s} s at most. A trip is called by its first drive. Times that no clock dates tell nothing across files.
WITH drive AS (
    SELECT
        drive_id,
        any_value(vehicle_id) AS vehicle_id,
        any_value(coalesce(trip_id, drive_id)) AS part_id,
        any_value(started_at) AS started_at,
        any_value(started_at + to_milliseconds((1000 * duration_s)::BIGINT)) AS ended_at
    FROM grams
    WHERE feature_set = '{feature_set}' AND (trip_id IS NOT NULL OR started_at IS NOT NULL)
    GROUP BY drive_id
),

-- What one file tells: drives that follow each other in it.
part AS (
    SELECT part_id, vehicle_id, min(started_at) AS started_at, max(ended_at) AS ended_at
    FROM drive
    GROUP BY part_id, vehicle_id
),

paused AS (
    SELECT
        *,
        started_at - max(ended_at) OVER (
            PARTITION BY vehicle_id ORDER BY started_at, part_id ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING
        ) AS pause
    FROM part
    WHERE started_at IS NOT NULL AND vehicle_id IS NOT NULL
),

numbered AS (
    SELECT
        *,
        count(*) FILTER (WHERE pause IS NULL OR pause > INTERVAL {longest_pause_s} SECOND) OVER (
            PARTITION BY vehicle_id ORDER BY started_at, part_id
        ) AS number
    FROM paused
),

trip AS (
    SELECT part_id, first_value(part_id) OVER (PARTITION BY vehicle_id, number ORDER BY started_at, part_id) AS trip
    FROM numbered
)

SELECT drive_id, coalesce(trip, part_id) AS trip
FROM drive
LEFT JOIN trip USING (part_id)
