-- The files of one snapshot of the Delta table.
read_parquet(getvariable('quarantine_files'), union_by_name => true)
