-- One Gram row a drive: exact sums and sums of products of the counts (docs/tables.md).
CREATE VIEW grams AS
SELECT
    feature_set,
    file,
    day,
    {drive_columns},
    part,
    signals,
    n,
    clipped,
    sums,
    products,
    course_late
FROM {stored_grams}
