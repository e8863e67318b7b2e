-- Drives of one car that overlap by more than a second, and the drive that each of them shares most time with: a car
-- drives once, so that their rows count twice. The view "drives" has a row or more for each drive; those whose time is
-- not known are left out.
-- A drive without a log (received) began when its name says, and lasted as long as its rows. Of such a drive and a log
-- it is named, since the log is used where both come; of two drives without one the longer, since one message that
-- covers a day must not accuse all others of that day; of two logs the one that begins later.
WITH known AS (
    SELECT
        vehicle_id::VARCHAR AS vehicle_id,
        drive_id::VARCHAR AS drive_id,
        bool_and(source = $received) AS without_log,
        min(CASE
            WHEN source = $received THEN epoch(try_strptime(right(drive_id::VARCHAR, 16), '%Y%m%dT%H%M%SZ'))
            ELSE epoch(started_at)
        END) AS start_s,
        start_s + greatest(
            max(coalesce(duration_s, 0)), sum(CASE WHEN source = $received THEN n * $sample_time_s ELSE 0 END)
        ) AS end_s
    FROM drives
    GROUP BY ALL
    HAVING start_s IS NOT NULL
),

earlier AS (
    FROM known
    QUALIFY lead(start_s) OVER (PARTITION BY vehicle_id ORDER BY start_s, drive_id) < end_s - $least_s
),

later AS (
    FROM known
    QUALIFY start_s + $least_s < max(end_s) OVER (
        PARTITION BY vehicle_id ORDER BY start_s, drive_id ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING
    )
),

pairs AS (
    SELECT
        earlier.drive_id AS first_id,
        later.drive_id AS second_id,
        least(earlier.end_s, later.end_s) - later.start_s AS common_s,
        earlier.without_log AND (
            NOT later.without_log OR earlier.end_s - earlier.start_s > later.end_s - later.start_s
        ) AS is_first
    FROM earlier
    JOIN later ON
        earlier.vehicle_id = later.vehicle_id
        AND (earlier.start_s, earlier.drive_id) < (later.start_s, later.drive_id)
        AND earlier.end_s > later.start_s + $least_s
    WHERE common_s > $least_s
)

SELECT
    CASE WHEN is_first THEN first_id ELSE second_id END AS named_id,
    max(common_s) AS most_s,
    min_by(CASE WHEN is_first THEN second_id ELSE first_id END, (-common_s, first_id, second_id)) AS other_id
FROM pairs
GROUP BY named_id
ORDER BY named_id
