-- The last run of each command, mistakes left out: a wrong option, config or question (exit codes 2, 3 and 5), a refusal (7)
-- and a package that is not installed (13) are a person's, unless the same command line has been done before.
WITH judged AS (
    SELECT
        *,
        coalesce(exit_code IN (2, 3, 5, 7, 13), FALSE) AND NOT bool_or(outcome IS NOT DISTINCT FROM 'done') OVER (
            PARTITION BY command, arguments ORDER BY started_at, run_id ROWS UNBOUNDED PRECEDING
        ) AS is_mistake
    FROM runs
)
SELECT
    run_id, command, started_at, ended_at, outcome, exit_code, error, seconds, rows, size_bytes, host, process, process_began
FROM judged
WHERE NOT is_mistake
QUALIFY row_number() OVER (PARTITION BY command ORDER BY started_at DESC, run_id DESC) = 1
ORDER BY started_at DESC
