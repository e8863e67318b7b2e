-- Rows with each course on the tick that it is of, but for the rest of a tick; hidden_late is its delay in parts of a tick.
SELECT * REPLACE (
    CASE WHEN hidden_late < 0
        THEN max(course) OVER (PARTITION BY drive_id ORDER BY tick
            RANGE BETWEEN greatest(-{whole_ticks}, 0) PRECEDING AND greatest(-{whole_ticks}, 0) PRECEDING)
        ELSE max(course) OVER (PARTITION BY drive_id ORDER BY tick
            RANGE BETWEEN greatest({whole_ticks}, 0) FOLLOWING AND greatest({whole_ticks}, 0) FOLLOWING)
    END AS course
)
FROM (SELECT *, coalesce(getvariable('course_late')[vehicle_id], 0) AS hidden_late FROM {rows})
