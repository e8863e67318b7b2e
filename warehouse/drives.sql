-- One row a drive. Every drive has exactly one row with tick 0, so that no more than that is read.
-- A drive of before its rows were counted has "rows" from its Gram rows, null until there are some. A car that sent Gram
-- rows has no log: its drives are told by them.
CREATE VIEW drives AS
WITH counted AS (
    SELECT drive_id, sum(row_count)::BIGINT AS counted_rows
    FROM grams
    WHERE feature_set = 'signals' AND rows IS NULL
    GROUP BY drive_id
)

SELECT
    day,
    {drive_columns_but_rows},
    coalesce(rows, counted_rows) AS rows
FROM log_counts
LEFT JOIN counted USING (drive_id)
WHERE tick = 0

UNION ALL

SELECT
    day,
    {drive_columns_but_rows},
    sum(row_count)::BIGINT AS rows
FROM grams
WHERE feature_set = 'signals' AND starts_with(file, 'received/')
GROUP BY ALL
