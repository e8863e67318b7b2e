"""The command that queries the data root: sql."""

import contextlib
import io
import logging
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import duckdb
import pyarrow as pa
from typer import Argument, Context, Option

from fleet_slip.base import pluralize
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import json_text, print_json, print_text, say
from fleet_slip.errors import QuestionError, StorageError, UsageError
from fleet_slip.warehouse.database import limit_memory, split_statements

if TYPE_CHECKING:
    from fleet_slip.views import Session

SCREEN_ROWS = 40
UNLIMITED = 2**31 - 1
MIN_TEXT = 24
"""Minimum width of a column of texts in characters: columns are left out rather than narrower."""
FORMULA = "^[=+@\\t\\r\\n＝＋－＠-]"
"""First characters of a text that a spreadsheet executes."""


def sql(
    context: Context,
    query: Annotated[str, Argument(help="SQL; - or nothing: statements from stdin.")] = "-",
    json: opt.Json = False,
    csv: Annotated[bool, Option("--csv", help="Print CSV on stdout.")] = False,
    exact: Annotated[
        bool,
        Option(
            "--exact",
            help="Print texts of CSV unchanged. By default, texts that a spreadsheet takes for "
            "formulas get an apostrophe.",
        ),
    ] = False,
    output: Annotated[Path | None, Option(help="File to write: .parquet, .csv or .json.")] = None,
    everything: opt.All = False,
    unsafe: Annotated[
        bool,
        Option(
            "--unsafe",
            help="Allow any statement, and any file that you may read or write. Use it only for "
            "SQL that you trust: it can overwrite the data root.",
        ),
    ] = False,
) -> None:
    """Query the data root: log (SI), log_counts, drives, grams, models, quarantine, dictionary.

    The view dictionary describes every column. Test drives are included if the query names the
    column source. A query can only read. A table is cut to the screen; --all prints all of it.
    --csv, --json and --output print numbers to the last digit. Several statements on stdin are
    executed in order.

    Example: fleet-slip sql "SELECT vehicle_id, count(*) AS drives FROM drives GROUP BY ALL"
    """
    if query == "-" and sys.stdin is not None and sys.stdin.isatty():
        raise UsageError('give a query: fleet-slip sql "FROM drives"; or pipe statements to it.')
    try:
        text = sys.stdin.read() if query == "-" else query
    except UnicodeDecodeError:
        raise QuestionError("the query on stdin is not UTF-8 text.") from None
    if output is not None and output.suffix not in {".parquet", ".csv", ".json"}:
        raise UsageError(f"{output}: choose the format by the suffix .parquet, .csv or .json.")
    if not unsafe:
        limit_memory()
    session = fleet_of(context).session(text, unlocked=unsafe)
    with session, _representation_errors():
        if output is not None:
            _write(session.table(text), output, exact)
            return
        several = query == "-" and not unsafe
        for statement in split_statements(session.database, text) if several else [text]:
            if json:
                print_json(session.table(statement).to_pylist())
            elif csv:
                content = io.BytesIO()
                _write_csv(session.table(statement), content, exact)
                print_text(content.getvalue().decode().removesuffix("\n"))
            else:
                _show(session, statement, everything)


def _write(rows: pa.Table, file: Path, exact: bool) -> None:
    """Write a result in the format of the suffix. Raises `StorageError`."""
    try:
        if file.suffix == ".parquet":
            import pyarrow.parquet as pq

            pq.write_table(rows, file)
        elif file.suffix == ".csv":
            _write_csv(rows, file, exact)
        else:
            file.write_text(json_text(rows.to_pylist()), "utf-8")
    except OSError as error:
        raise StorageError(f"{file}: {error.strerror or error}.") from None
    say(f"{file}: {pluralize(rows.num_rows, 'row')}, {file.stat().st_size:,} bytes")


def _write_csv(rows: pa.Table, to: Any, exact: bool) -> None:
    from pyarrow.csv import write_csv

    write_csv(rows if exact else _mark_formulas(rows), to)


_CUT = re.compile(r"│ … │|\S… │|rows .*shown\)|columns .*shown\)")


def _show(session: "Session", text: str, everything: bool) -> None:
    """Print a result cut to the screen, with a remark if it is cut."""
    width = UNLIMITED if everything else shutil.get_terminal_size((160, 40)).columns
    rows = UNLIMITED if everything else SCREEN_ROWS
    table = session.compute(text, lambda result: _draw(result, width, rows))
    print_text(table)
    if _CUT.search(table):
        say("output truncated. Select fewer columns, or: --all")


def _draw(result: duckdb.DuckDBPyRelation, width: int, rows: int) -> str:
    """Return a result as DuckDB's table of at most this width, numbers of 15 digits."""
    names = result.columns
    if len(set(names)) == len(names):
        doubles = [name for name, kind in zip(names, result.types, strict=True) if kind == "DOUBLE"]
        quoted = ['"' + name.replace('"', '""') + '"' for name in doubles]
        rounded = [f"CAST(printf('%.15g', {name}) AS DOUBLE) AS {name}" for name in quoted]
        result = result.project(f"* REPLACE ({', '.join(rounded)})" if rounded else "*")

    def draw(max_text: int) -> str:
        with contextlib.redirect_stdout(io.StringIO()) as output:
            result.show(max_rows=rows, max_width=width, max_col_width=max_text)
        return output.getvalue().rstrip("\n")

    table = draw(width)
    if width < UNLIMITED and "│ … │" in table:  # a wide text leaves no room for other columns
        table = draw(max(width // len(names) - 3, MIN_TEXT))
    return table


def _mark_formulas(table: pa.Table) -> pa.Table:
    """Put an apostrophe before texts that a spreadsheet takes for formulas, with a warning.

    Foreign logs may contain names such as `=HYPERLINK(…)`. After OWASP, "CSV Injection".
    """
    import pyarrow.compute as pc

    marked = 0
    for i, field in enumerate(table.schema):
        if pa.types.is_string(field.type) or pa.types.is_large_string(field.type):
            formula = pc.match_substring_regex(table[i], FORMULA)
            marked += pc.sum(formula).as_py() or 0
            quoted = pc.binary_join_element_wise(pa.scalar("'", field.type), table[i], "")
            table = table.set_column(i, field.name, pc.if_else(formula, quoted, table[i]))
    if marked:
        say(
            f"{marked:,} texts that begin like a formula of a spreadsheet are marked by an "
            "apostrophe. As they are: --exact",
            logging.WARNING,
        )
    return table


@contextlib.contextmanager
def _representation_errors() -> Iterator[None]:
    """Explain values that Python, JSON or CSV cannot represent, such as lists in CSV."""
    try:
        yield
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise QuestionError(
            f"cannot print the result: {error}. Cast the column, such as: CAST(sums AS TEXT)"
        ) from None
