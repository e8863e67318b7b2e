-- One row a drive. Every drive has exactly one row with tick 0, so that no more than that is read.
-- "rows" is null until the Gram job has read the drive.
CREATE VIEW drives AS
WITH counted AS (
    SELECT drive_id, sum(n)::BIGINT AS rows
    FROM grams
    WHERE feature_set = 'signals'
    GROUP BY drive_id
)

SELECT
    day,
    {drive_columns},
    counted.rows
FROM log_counts
LEFT JOIN counted USING (drive_id)
WHERE tick = 0
