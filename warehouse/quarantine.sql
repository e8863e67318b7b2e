-- Rows of measured logs that were refused, with the reason.
CREATE VIEW quarantine AS
SELECT *
FROM {stored_quarantine}
