-- One Gram row for each drive of the given log files: row count, sums and sums of products of the counts.
--
-- Integer sums are exact, so the result does not depend on row order, threads or file layout. A row that lacks a
-- signal must not count for the others' products alone: rows are grouped by which signals they lack ("absent", a
-- number with one bit for each signal). Where the Delta log proves that no file has a signal in only some of its
-- rows, "absent" is the constant 0 and not grouped by, which is faster and gives the same rows: grouped by the one
-- dictionary column drive_id, rows are not hashed at all.
--
-- Features may be clipped to int16 ("clipped" says how often). "part" is of sets that the compiled kernel alone computes.
--
-- INTEGER products: SMALLINT * SMALLINT would overflow. union_by_name: gives DuckDB the files' statistics, from which
-- it knows that no sum can overflow; without it the query is three times slower.
WITH drive AS (
    SELECT
        {drive_columns},
        day,
        filename AS file
    FROM read_parquet(
        getvariable('log_files'),
        union_by_name => true, filename => true, hive_partitioning => true, hive_types => {{'day': DATE}}
    )
    WHERE tick = 0
),

gram AS (
    SELECT
        drive_id,
        {absent} AS absent,
        count(*) AS n,
        {clipped} AS clipped,
        [
            {sums}
        ]::BIGINT[] AS sums,
        [
            {products}
        ]::BIGINT[] AS products
    FROM {counts}
    GROUP BY {group}
)

SELECT
    $feature_set AS feature_set,
    drive.file,
    drive.day,
    {qualified_drive_columns},
    NULL::VARCHAR AS part,
    array_to_string(list_where([{names}], [s IS NOT NULL FOR s IN gram.sums]), ',') AS signals,
    gram.n,
    gram.clipped,
    [s FOR s IN gram.sums IF s IS NOT NULL] AS sums,
    [p FOR p IN gram.products IF p IS NOT NULL] AS products
FROM gram
JOIN drive USING (drive_id)
ORDER BY drive.file, drive_id, gram.absent
