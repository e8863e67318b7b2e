-- Columns less what they were {ticks} ticks ago, and the change of the side-slip angle as the label. Only rows that have a
-- fix now and had one then, and the yaw rate all the time between; and the first of a drive, which has no change, so that a
-- drive without a course is known to have none.
SELECT
    * EXCLUDE (hidden_course, hidden_turned, hidden_rest, hidden_rate, hidden_late) REPLACE ({change} AS {label}),
    {coarser} AS turned,
    {straight} AS straight,
    {straight} * ({change}) AS straight_course
FROM (
    SELECT * REPLACE (({left} - {whole} * ({turns})) AS {label})
    FROM (
        SELECT
            * REPLACE (
            {changes},
            0::BIGINT AS {label}
            ),
            course::BIGINT - (max(course) OVER ago)::BIGINT AS hidden_course,
            CASE WHEN (count(yaw_rate) OVER since) = {ticks}
                THEN 2 * (sum(yaw_rate) OVER since)::BIGINT - yaw_rate + (max(yaw_rate) OVER ago)::BIGINT
            END AS hidden_turned,
            {gain} * (yaw_rate::BIGINT - (max(yaw_rate) OVER ago)::BIGINT) AS hidden_rest,
            greatest(abs(yaw_rate), abs((max(yaw_rate) OVER ago)::BIGINT)) AS hidden_rate
        FROM {rows}
        WINDOW
            ago AS (PARTITION BY drive_id ORDER BY tick RANGE BETWEEN {ticks} PRECEDING AND {ticks} PRECEDING),
            since AS (PARTITION BY drive_id ORDER BY tick RANGE BETWEEN {since} PRECEDING AND CURRENT ROW)
    )
)
WHERE abs({label}) <= {largest} OR tick = 0
