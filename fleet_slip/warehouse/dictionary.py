"""What every column of every view means, as comments in DuckDB and as a table of its own."""

from functools import cache

import duckdb
import pyarrow as pa
from pydantic import Field, RootModel

from fleet_slip.catalogue.signals import SignalCatalogue
from fleet_slip.config import Config, load_toml
from fleet_slip.resources import folder
from fleet_slip.warehouse.database import sql_text

COMMON = "common"
"""Section of `warehouse/columns.toml` for columns of several views."""


class ColumnDescription(Config):
    """What a column means."""

    description: str = Field(min_length=1)
    unit: str = ""


class _Descriptions(RootModel[dict[str, dict[str, ColumnDescription]]]):
    """By view and column."""


@cache
def column_descriptions() -> dict[str, dict[str, ColumnDescription]]:
    """Return the descriptions that stand beside the SQL of the views, by view and column."""
    return _Descriptions.model_validate(load_toml(folder("warehouse") / "columns.toml")).root


def describe_columns(database: duckdb.DuckDBPyConnection, signals: SignalCatalogue) -> pa.Table:
    """Comment the views' columns, and return all columns with unit and description as a table."""
    from_catalogue = _catalogue_descriptions(signals)
    by_view = column_descriptions()
    found = database.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() "
        "WHERE NOT internal AND NOT starts_with(table_name, 'empty_') "
        "ORDER BY table_name, column_index"
    ).fetchall()
    rows = []
    for view, column, data_type in found:
        described = {**from_catalogue, **by_view[COMMON], **by_view.get(view, {})}.get(column)
        unit, description = (described.unit, described.description) if described else ("", "")
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
            database.execute(f"COMMENT ON COLUMN {view}.{column} IS {sql_text(text)}")
    return pa.Table.from_pylist(rows)


def _catalogue_descriptions(signals: SignalCatalogue) -> dict[str, ColumnDescription]:
    described = {
        name: ColumnDescription(description=column.description)
        for name, column in signals.drive.items()
    }
    for name, signal in signals.signals.items():
        count = f"{signal.scale} {signal.unit}"
        described[name] = ColumnDescription(description=signal.description, unit=count)
        described[signal.column] = ColumnDescription(
            description=signal.description, unit=signal.unit
        )
    return described
