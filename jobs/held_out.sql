-- How many rows of held-out drives fall into each cell of true angle, estimate and size of lateral acceleration.
-- Each drive is estimated by the model that was fitted without its fold: the table held_out has a row of coefficients
-- for each drive. The parameters are the widths of the cells.
WITH estimated AS (
    SELECT
        degrees({label}) AS truth_deg,
        degrees({estimate}) AS estimate_deg,
        abs(ay_mps2) AS ay_mps2
    FROM log
    INNER JOIN held_out USING (drive_id)
    WHERE {complete}
)

SELECT
    floor(truth_deg / $angle_deg)::INTEGER AS truth,
    floor(estimate_deg / $angle_deg)::INTEGER AS estimate,
    floor(ay_mps2 / $acceleration_mps2)::INTEGER AS acceleration,
    count(*) AS rows
FROM estimated
GROUP BY ALL
ORDER BY ALL
