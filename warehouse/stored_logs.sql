-- The files of one snapshot of the Delta table. With union_by_name DuckDB opens every file's footer before it looks at
-- the query; without, only those of the days that the query asks for. It is needed where files have different columns.
read_parquet(
    getvariable('log_files'),
    union_by_name => getvariable('log_columns_differ'), hive_partitioning => true, hive_types => {'day': DATE}
)
