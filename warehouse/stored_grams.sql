-- The files of one snapshot of the Delta table. A Gram row counts while its log file is active: until its Gram rows are
-- dropped, what was forgotten or compacted away is not seen. One that a car sent has no log file, and always counts.
(
    FROM read_parquet(getvariable('gram_files'), union_by_name => true)
    WHERE file IN (SELECT unnest(getvariable('active_log_files'))) OR starts_with(file, 'received/')
)
