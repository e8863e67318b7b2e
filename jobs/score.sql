-- How a published model does on the rows of a cohort: estimate minus truth, in degrees.
-- Angles are added up as whole steps of {step_rad} rad: so the figures are the same to the bit on every run, whatever
-- thread adds what. Only order statistics are of the angles themselves.
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
        round(estimate_rad / {step_rad})::HUGEINT AS estimate,
        round(truth_rad / {step_rad})::HUGEINT AS truth,
        abs(degrees(estimate_rad - truth_rad)) AS size_deg
    FROM scored
),

sums AS (
    SELECT
        count(*) AS rows,
        min(estimate) < max(estimate) AND min(truth) < max(truth) AS varied,
        sum(estimate)::DOUBLE AS estimates,
        sum(truth)::DOUBLE AS truths,
        sum(estimate * estimate)::DOUBLE AS estimates_squared,
        sum(truth * truth)::DOUBLE AS truths_squared,
        sum(estimate * truth)::DOUBLE AS products,
        sum(estimate - truth)::DOUBLE AS errors,
        sum(abs(estimate - truth))::DOUBLE AS sizes,
        sum((estimate - truth) * (estimate - truth))::DOUBLE AS errors_squared,
        quantile_cont(size_deg, [0.5, 0.95, 0.99]) AS error_percentiles_deg,
        max(size_deg) AS error_max_deg
    FROM errors
)

SELECT
    rows,
    CASE WHEN varied THEN
        (rows * products - estimates * truths)
        / sqrt(rows * estimates_squared - estimates * estimates)
        / sqrt(rows * truths_squared - truths * truths)
    END AS correlation,
    degrees(sqrt(errors_squared / rows) * {step_rad}) AS rmse_deg,
    degrees(errors / rows * {step_rad}) AS error_mean_deg,
    degrees(
        sqrt(greatest(errors_squared - errors * errors / rows, 0) / nullif(rows - 1, 0)) * {step_rad}
    ) AS error_std_deg,
    degrees(sizes / rows * {step_rad}) AS error_mean_absolute_deg,
    error_percentiles_deg,
    error_max_deg
FROM sums
