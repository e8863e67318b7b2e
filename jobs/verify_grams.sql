-- Gram rows that stand twice.
SELECT
    feature_set,
    file,
    drive_id,
    count(*) AS n
FROM read_parquet(getvariable('files'), union_by_name => true)
GROUP BY feature_set, file, drive_id, part, signals
HAVING n > 1
ORDER BY ALL
