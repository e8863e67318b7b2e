-- The last run of each command.
SELECT run_id, command, started_at, ended_at, outcome, exit_code, error, seconds, rows, size_bytes, host, process
FROM runs
QUALIFY row_number() OVER (PARTITION BY command ORDER BY started_at DESC, run_id DESC) = 1
ORDER BY started_at DESC
