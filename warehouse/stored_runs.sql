-- The lines of the history. A line that a full disk tore is not JSON, and is skipped.
read_json(
    getvariable('run_files'), columns => {run_columns}, format => 'newline_delimited', ignore_errors => true
)
