-- The logs of scenario drives in SI units. The parameter names the drives.
SELECT
    drive_id,
    lost_control_s,
    time_s,
    {columns}
FROM log
WHERE source = '{source}' AND drive_id IN (SELECT unnest($drives))
ORDER BY drive_id, time_s
