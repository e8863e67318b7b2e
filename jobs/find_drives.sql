-- The drives of log files that satisfy a condition, and the file of each. Every drive has one row with tick 0.
SELECT
    drive_id,
    filename AS file
FROM read_parquet(
    getvariable('log_files'),
    filename => true, hive_partitioning => true, hive_types => {{'day': DATE}}
)
WHERE tick = 0 AND {condition}
ORDER BY ALL
