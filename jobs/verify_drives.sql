-- Drives that are not whole: in several files, without a beginning or with two, or with more rows than ticks.
SELECT
    drive_id,
    count(DISTINCT filename) AS files,
    count(*) FILTER (WHERE tick = 0) AS beginnings,
    count(*) AS n,
    min(filename) AS file
FROM read_parquet(getvariable('files'), union_by_name => true, filename => true, hive_partitioning => false)
GROUP BY drive_id
HAVING files <> 1 OR beginnings <> 1 OR n > max(tick) + 1 OR min(tick) < 0
ORDER BY drive_id
