-- The files of one snapshot of the Delta table. Without union_by_name DuckDB ignores the statistics of all but one file.
read_parquet(
    getvariable('log_files'),
    union_by_name => true, hive_partitioning => true, hive_types => {'day': DATE}
)
