"""What every column of every view means, as comments in DuckDB and as a table of its own."""

import duckdb
import pyarrow as pa

from fleet_slip.catalogue.signals import SignalCatalogue


def describe_columns(database: duckdb.DuckDBPyConnection, signals: SignalCatalogue) -> pa.Table:
    """Comment the views' columns, and return all columns with unit and description as a table."""
    described = {name: ("", column.description) for name, column in signals.drive.items()}
    described |= {
        name: (f"{s.scale} {s.unit}", s.description) for name, s in signals.signals.items()
    }
    described |= {s.column: (s.unit, s.description) for s in signals.signals.values()}
    described |= _OTHER_COLUMNS
    found = database.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() "
        "WHERE NOT internal AND NOT starts_with(table_name, 'empty_') "
        "ORDER BY table_name, column_index"
    ).fetchall()
    rows = []
    for view, column, data_type in found:
        unit, description = described.get(column, ("", ""))
        rows.append(
            {
                "view": view,
                "column": column,
                "type": data_type,
                "unit": unit,
                "description": description,
            }
        )
        if description:
            text = f"{description} [{unit}]" if unit else description
            quoted = text.replace("'", "''")
            database.execute(f"COMMENT ON COLUMN {view}.{column} IS '{quoted}'")
    return pa.Table.from_pylist(rows)


_OTHER_COLUMNS = {
    "day": ("", "Date of the drive"),
    "tick": ("0.01 s", "Samples since the drive began; every drive has a row with tick 0"),
    "time_s": ("s", "Time since the drive began"),
    "rows": ("", "Of a drive: as the Gram job counted them. Of a run: of its largest step"),
    "feature_set": (
        "",
        "Which columns were multiplied: signals, or a set of features.toml",
    ),
    "file": ("", "File below logs/ that the Gram row was computed from, or the file ingested"),
    "signals": ("", "Signals of a Gram row or model, separated by commas, in the order of sums"),
    "part": ("", "Rows of the drive that a Gram row is of, such as a speed band; null: all"),
    "n": ("", "Number of rows in the sums"),
    "clipped": ("", "Number of values of features that were clipped to the range of int16"),
    "sums": ("counts", "Sum of each signal's counts"),
    "products": (
        "counts^2",
        "Sums of products, lower triangle row by row: (0,0), (1,0), (1,1) ...",
    ),
    "row": ("", "Row of the ingested file, from 1"),
    "reason": ("", "Why the row was refused"),
    "signal": ("", "The signal that was wrong"),
    "value": ("", "The refused value, as text"),
    "name": ("", "Name of the model"),
    "version": ("", "Number of the model version: 1, 2, 3 ..."),
    "aliases": ("", "Aliases that point at the version now, separated by commas"),
    "published_at": ("", "When the version was published, UTC"),
    "correlation": ("", "Pooled cross-validated correlation"),
    "rmse_deg": ("deg", "Cross-validated root mean square error"),
    "error_mean_deg": ("deg", "Cross-validated mean of the error, estimate minus truth"),
    "error_std_deg": ("deg", "Cross-validated standard deviation of the error"),
    "cohort": ("", "SQL condition on drives that the model was trained on"),
    "drives": ("", "Number of drives that the model was trained on"),
    "sha256": ("", "Checksum of the manifest"),
    "run_id": ("", "Name of a run of a command; sorts by the time of its start"),
    "command": ("", "The command that ran"),
    "arguments": ("", "Its command line, without what may be secret"),
    "started_at": ("", "When the run started, by the clock of its host"),
    "ended_at": ("", "When the run ended; null if it is under way or was killed"),
    "outcome": ("", "done, failed or interrupted; null if the run is under way or was killed"),
    "exit_code": ("", "Exit code of the command"),
    "error": ("", "Why the run failed"),
    "seconds": ("s", "How long the run took"),
    "size_bytes": ("", "Size of the data files that the run wrote"),
    "steps": ("", "Steps of the run: name, seconds, rows, size of the data files written"),
    "host": ("", "Name of the machine"),
    "process": ("", "Number of the process"),
    "package_version": ("", "Version of fleet-slip"),
}
