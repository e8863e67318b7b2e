-- Every so many rows of the given drives in SI units, where all the columns have a value.
SELECT
    drive_id,
    {columns}
FROM log
WHERE drive_id IN (SELECT unnest($drives))
    AND round(time_s * {samples_per_second})::INTEGER % $stride = 0
    AND {complete}
ORDER BY drive_id, time_s
