-- All rows, in the order of time, of the drives that have a row of a cohort, and which rows are of it. What looks back
-- needs the rows before, too. The predicate may use the columns of the views "log" and "log_counts".
WITH counted AS (
    SELECT
        *,
        coalesce(({predicate}), false) AS chosen
    FROM {rows}
)

SELECT
    drive_id,
    tick,
    {columns},
    chosen
FROM counted
WHERE drive_id IN (SELECT drive_id FROM counted WHERE chosen)
ORDER BY drive_id, tick
