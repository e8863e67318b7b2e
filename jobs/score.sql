-- How a published model does on the rows of a cohort: estimate minus truth, in degrees.
WITH scored AS (
    SELECT
        {estimate} AS estimate_rad,
        {label} AS truth_rad
    FROM {rows}
    WHERE {complete} AND (
        {condition}
    )
),

errors AS (
    SELECT
        estimate_rad,
        truth_rad,
        degrees(estimate_rad - truth_rad) AS error_deg
    FROM scored
)

SELECT
    count(*) AS rows,
    corr(estimate_rad, truth_rad) AS correlation,
    sqrt(avg(error_deg * error_deg)) AS rmse_deg,
    avg(error_deg) AS error_mean_deg,
    stddev_samp(error_deg) AS error_std_deg,
    avg(abs(error_deg)) AS error_mean_absolute_deg,
    quantile_cont(abs(error_deg), [0.5, 0.95, 0.99]) AS error_percentiles_deg,
    max(abs(error_deg)) AS error_max_deg
FROM errors
