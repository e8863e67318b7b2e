-- The drives that cars sent Gram rows of and that logs have come of, and the files that have rows of theirs. A drive is the
-- same by its name, or by its car, day and exactly the same counts of the logged signals.
WITH received AS (
    SELECT drive_id, feature_set, vehicle_id, day, signals, n, sums, products, filename
    FROM read_parquet(getvariable('gram_files'), union_by_name => true, filename => true)
),

found AS (
    SELECT drive_id FROM received SEMI JOIN logged USING (drive_id)
    UNION
    SELECT drive_id
    FROM received
    SEMI JOIN logged USING (vehicle_id, day, feature_set, signals, n, sums, products)
    WHERE feature_set = '{plain}'
)

SELECT DISTINCT drive_id, filename FROM received SEMI JOIN found USING (drive_id)
