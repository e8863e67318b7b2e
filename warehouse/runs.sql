-- The commands that changed the warehouse, one row a run. A run without an outcome is under way or was killed.
CREATE VIEW runs AS
SELECT
    run_id,
    any_value(command) AS command,
    any_value(arguments) AS arguments,
    any_value(started_at)::TIMESTAMPTZ AS started_at,
    any_value(ended_at)::TIMESTAMPTZ AS ended_at,
    any_value(outcome) AS outcome,
    any_value(exit_code) AS exit_code,
    any_value(error) AS error,
    any_value(seconds) AS seconds,
    list_max(list_transform(any_value(steps), lambda step: step.rows)) AS rows,
    list_sum(list_transform(any_value(steps), lambda step: step.size_bytes))::BIGINT AS size_bytes,
    any_value(steps) AS steps,
    any_value(host) AS host,
    any_value(process) AS process,
    any_value(process_began) AS process_began,
    any_value(package_version) AS package_version
FROM {stored_runs}
WHERE run_id IS NOT NULL
GROUP BY run_id
