"""Commands that read the warehouse in SQL: sql, shell."""

import shutil
import sys
from typing import Annotated

import duckdb
import typer
from pyarrow.csv import write_csv

from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.connection import connect
from fleet_slip.database import database_errors, one_query
from fleet_slip.errors import FleetSlipError

ROWS_SHOWN = 40


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(sql)
    app.command()(shell)


def sql(
    context: typer.Context,
    query: Annotated[
        str, typer.Argument(help='SQL, such as "FROM drives LIMIT 5". - reads it from stdin.')
    ],
    json: Json = False,
    csv: Annotated[bool, typer.Option("--csv", help="Print CSV on stdout.")] = False,
) -> None:
    """Query the warehouse: log (SI), log_counts, drives, grams, models, quarantine, dictionary.

    Every column is described in the view dictionary.
    """
    text = sys.stdin.read() if query == "-" else query
    with connect(context.obj.root) as database:
        _answer(database, text, json=json, csv=csv)


def _answer(
    database: duckdb.DuckDBPyConnection, text: str, *, json: bool = False, csv: bool = False
) -> None:
    one_query(database, text)
    with database_errors("the query"):
        if json or csv:
            rows = database.sql(text).to_arrow_table()
            if csv:
                write_csv(rows, sys.stdout.buffer)
            else:
                print_json(rows.to_pylist())
        else:
            relation = database.sql(text)
            relation.show(max_rows=ROWS_SHOWN, max_width=_width())


def _width() -> int:
    return shutil.get_terminal_size((160, 40)).columns


def shell(context: typer.Context) -> None:
    """Type SQL queries against the warehouse, one after the other. End with .quit or Ctrl-D."""
    import readline  # noqa: F401, PLC0415 - gives input() history and editing

    with connect(context.obj.root) as database:
        say("Views: log, log_counts, drives, grams, models, quarantine, dictionary. End: .quit")
        while (text := _read_statement()) is not None:
            try:
                if text.strip():
                    _answer(database, text)
            except FleetSlipError as error:
                say(f"error: {error}")
            except KeyboardInterrupt:
                say("interrupted")


def _read_statement() -> str | None:
    """Read lines until one ends with a semicolon; None at the end of the input."""
    lines: list[str] = []
    while True:
        try:
            line = input("   ...> " if lines else "slip> ")
        except EOFError:
            return "\n".join(lines) or None
        except KeyboardInterrupt:
            return ""
        if not lines and line.strip() in (".quit", ".exit", "quit", "exit"):
            return None
        lines.append(line)
        if line.rstrip().endswith(";") or not line.strip():
            return "\n".join(lines)
