-- The logs as they are stored: integer counts at 100 Hz, null where a signal is absent.
CREATE VIEW log_counts AS
SELECT
    day,
    {drive_columns},
    tick,
    {signals}
FROM {stored_logs}
