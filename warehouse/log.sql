-- The logs in SI units: physical = scale * count (configs/signals.toml).
CREATE VIEW log AS
SELECT
    day,
    {drive_columns},
    tick,
    tick / {samples_per_second}::DOUBLE AS time_s,
    {si_columns}
FROM log_counts
