"""The command that asks the warehouse a query: sql."""

import contextlib
import io
import logging
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import duckdb
import pyarrow as pa
import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.api.session import Session
from fleet_slip.base import pluralize
from fleet_slip.cli.options import command
from fleet_slip.cli.output import Json, json_text, print_json, print_text, say
from fleet_slip.errors import QuestionError, StorageError, UsageError
from fleet_slip.warehouse.database import limit_memory, split_statements

ROWS_SHOWN = 40
ENDLESS = 2**31 - 1
FEW_COLUMNS = 3
"""So many have room side by side, whatever they hold."""
FORMULA = "^[=+@\\t\\r\\n＝＋－＠-]"
"""What a text begins with that a spreadsheet executes."""


@command()
def sql(
    fleet: Fleet,
    query: Annotated[
        str,
        typer.Argument(
            help='SQL, such as "FROM drives LIMIT 5". - or nothing: statements from stdin.',
            show_default=False,
        ),
    ] = "-",
    json: Json = False,
    csv: Annotated[bool, typer.Option("--csv", help="Print CSV on stdout.")] = False,
    exact: Annotated[
        bool,
        typer.Option(
            "--exact",
            help="Print texts of CSV as they are, also those that a spreadsheet would take for "
            "formulas. Otherwise these are marked by an apostrophe.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(help="Write to a file: .parquet, .csv or .json.", show_default=False),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all rows and columns of a table, however wide.")
    ] = False,
    unsafe: Annotated[
        bool,
        typer.Option(
            "--unsafe",
            help="Allow any statement, and any file that you may read or write. Only for SQL that "
            "you trust: it can overwrite the warehouse.",
        ),
    ] = False,
) -> None:
    """Query the warehouse: log (SI), log_counts, drives, grams, models, quarantine, dictionary.

    Every column is described in the view dictionary. Test drives are there if the query
    names the column source. A query can read the warehouse, and nothing else. A table
    shows what fits of columns and rows; --all shows all. --csv, --json and --output give numbers to
    the last digit. Several statements on stdin are answered one after the other.

    Example: fleet-slip sql "SELECT vehicle_id, count(*) AS drives FROM drives GROUP BY ALL"
    """
    if query == "-" and sys.stdin is not None and sys.stdin.isatty():
        raise UsageError('give a query: fleet-slip sql "FROM drives"; or pipe statements to it.')
    try:
        text = sys.stdin.read() if query == "-" else query
    except UnicodeDecodeError:
        raise QuestionError("the query on stdin is not UTF-8 text.") from None
    if output is not None and output.suffix not in {".parquet", ".csv", ".json"}:
        raise UsageError(f"{output}: the suffix says the format: .parquet, .csv or .json.")
    if not unsafe:
        limit_memory()
    opened = fleet.session(text, unlocked=unsafe)
    with opened as session, _representation_errors():
        if output is not None:
            _write(session.table(text), output, exact)
            return
        several = query == "-" and not unsafe
        for statement in split_statements(session.database, text) if several else [text]:
            if json:
                print_json(session.table(statement).to_pylist())
            elif csv:
                _print_csv(session.table(statement), exact)
            else:
                _show(session, statement, everything)


def _write(rows: pa.Table, file: Path, exact: bool) -> None:
    """Write an answer as the suffix says. Raises `StorageError`."""
    try:
        if file.suffix == ".parquet":
            import pyarrow.parquet as pq  # noqa: PLC0415 - takes a while

            pq.write_table(rows, file)
        elif file.suffix == ".csv":
            _write_csv(rows, file, exact)
        else:
            file.write_text(json_text(rows.to_pylist()), "utf-8")
    except OSError as error:
        raise StorageError(f"{file}: {error.strerror or error}.") from None
    say(f"{file}: {pluralize(rows.num_rows, 'row')}, {file.stat().st_size:,} bytes")


def _write_csv(rows: pa.Table, to: Any, exact: bool) -> None:
    from pyarrow.csv import write_csv  # noqa: PLC0415 - with what computes, a tenth of a second

    write_csv(rows if exact else _mark_formulas(rows), to)


def _print_csv(rows: pa.Table, exact: bool) -> None:
    if sys.stdout.isatty():
        content = io.BytesIO()
        _write_csv(rows, content, exact)
        print_text(content.getvalue().decode().removesuffix("\n"))
        return
    sys.stdout.flush()
    _write_csv(rows, sys.stdout.buffer, exact)
    sys.stdout.buffer.flush()


_CUT = re.compile(r"│ … │|\S… │|rows .*shown\)|columns .*shown\)")


def _show(session: Session, text: str, everything: bool) -> None:
    """Print what fits of an answer, and say if that is not all."""
    width = ENDLESS if everything else shutil.get_terminal_size((160, 40)).columns
    rows = ENDLESS if everything else ROWS_SHOWN
    shown = session.compute(text, lambda answer: _drawn(answer, width, rows))
    print_text(shown)
    if _CUT.search(shown):
        say("output truncated. Select fewer columns, or: --all")


def _readable(answer: duckdb.DuckDBPyRelation) -> duckdb.DuckDBPyRelation:
    """Return an answer whose numbers have 15 digits: 52.66, where binary has 52.660000000000004."""
    if len(set(answer.columns)) < len(answer.columns):
        return answer
    quoted = {name: '"' + name.replace('"', '""') + '"' for name in answer.columns}
    return answer.project(
        ", ".join(
            f"CAST(printf('%.15g', {quoted[name]}) AS DOUBLE) AS {quoted[name]}"
            if kind == "DOUBLE"
            else quoted[name]
            for name, kind in zip(answer.columns, answer.types, strict=True)
        )
    )


def _drawn(answer: duckdb.DuckDBPyRelation, width: int, rows: int) -> str:
    answer = _readable(answer)
    # A text as wide as all leaves other columns no room, or has none itself.
    for longest in (width, width // max(2, len(answer.columns)) - 3):
        with contextlib.redirect_stdout(io.StringIO()) as drawn:
            answer.show(max_rows=rows, max_width=width, max_col_width=longest)
        few = len(answer.columns) <= FEW_COLUMNS and "│ … │\n" in drawn.getvalue()
        if not few and not drawn.getvalue().startswith("┌───┐\n│ … │"):
            break
    return drawn.getvalue().rstrip("\n")


def _mark_formulas(answer: pa.Table) -> pa.Table:
    """Put an apostrophe before texts that a spreadsheet would take for formulas, and say so.

    Logs of others may hold names such as `=HYPERLINK(…)`. After OWASP, "CSV Injection".
    """
    import pyarrow.compute as pc  # noqa: PLC0415 - see above

    marked = 0
    for i, field in enumerate(answer.schema):
        if pa.types.is_string(field.type) or pa.types.is_large_string(field.type):
            formula = pc.match_substring_regex(answer[i], FORMULA)
            marked += pc.sum(formula).as_py() or 0
            quoted = pc.binary_join_element_wise(pa.scalar("'", field.type), answer[i], "")
            answer = answer.set_column(i, field.name, pc.if_else(formula, quoted, answer[i]))
    if marked:
        say(
            f"{marked:,} texts that begin like a formula of a spreadsheet are marked by an "
            "apostrophe. As they are: --exact",
            logging.WARNING,
        )
    return answer


@contextlib.contextmanager
def _representation_errors() -> Iterator[None]:
    """Explain values that Python, JSON or CSV has no form for, such as lists in CSV."""
    try:
        yield
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise QuestionError(
            f"cannot print the result: {error}. Cast the column, such as: CAST(sums AS TEXT)"
        ) from None
