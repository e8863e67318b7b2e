-- One row a drive. Every drive has exactly one row with tick 0, so that no more than that is read.
-- "rows" is null until the Gram job has read the drive. A car that sent Gram rows has no log: its drives are told by them.
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

UNION ALL

SELECT
    day,
    {drive_columns},
    sum(n)::BIGINT AS rows
FROM grams
WHERE feature_set = 'signals' AND starts_with(file, 'received/')
GROUP BY ALL
