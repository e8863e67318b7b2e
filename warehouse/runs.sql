-- The commands that changed the warehouse, one row a run, of its one or two lines. A run without an outcome is under way
-- or was killed.
CREATE TABLE runs AS
WITH records AS (
    SELECT
        unnest(from_json(line, '{
            "run_id": "VARCHAR", "command": "VARCHAR", "arguments": ["VARCHAR"], "started_at": "VARCHAR", "ended_at": "VARCHAR",
            "outcome": "VARCHAR", "exit_code": "INTEGER", "error": "VARCHAR", "seconds": "DOUBLE",
            "steps": [{"name": "VARCHAR", "seconds": "DOUBLE", "rows": "BIGINT", "size_bytes": "BIGINT"}],
            "host": "VARCHAR", "process": "INTEGER", "process_began": "VARCHAR", "package_version": "VARCHAR"
        }'))
    FROM run_lines
)
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
FROM records
WHERE run_id IS NOT NULL
GROUP BY run_id
