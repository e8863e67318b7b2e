-- One Gram row a drive: exact sums and sums of products of the counts (docs/tables.md).
CREATE VIEW grams AS
SELECT
    feature_set,
    file,
    day,
    {drive_columns},
    part AS block,
    signals,
    n AS row_count,
    clipped,
    sums,
    products,
    course_late AS course_delay_quarter_ticks
FROM {stored_grams}
