-- How many cars the rows are of that jobs/score.sql scores.
SELECT count(DISTINCT vehicle_id)
FROM {rows}
WHERE {complete} AND (
    {condition}
)
