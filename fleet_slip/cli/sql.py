"""The command that asks the warehouse a query: sql."""

import contextlib
import io
import logging
import re
import shutil
import sys
from collections.abc import Iterator
from enum import StrEnum
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Annotated

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import typer
from pyarrow.csv import write_csv

from fleet_slip.api.fleet import Fleet
from fleet_slip.api.session import Session
from fleet_slip.base import number_of
from fleet_slip.cli.output import Json, cell, json_text, print_json, print_table, say
from fleet_slip.errors import QuestionError, StorageError, UsageError
from fleet_slip.warehouse.database import limit_memory, split_statements

ROWS_SHOWN = 40
ENDLESS = 2**31 - 1
ROWS_FOLDED = 1000
"""Of more, --all prints lines as wide as they are: to fold them would take long."""
FORMULA = "^[=+@\\t\\r\\n＝＋－＠-]"
"""What a text begins with that a spreadsheet executes."""

Scenarios = Annotated[
    bool, typer.Option("--scenarios", help="Show the drives that models are tested on as well.")
]


def sql(
    context: typer.Context,
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
    limit: Annotated[
        int | None, typer.Option(min=0, help="Take so many rows and no more.", show_default=False)
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all rows and columns of a table, however wide.")
    ] = False,
    scenarios: Scenarios = False,
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

    Every column is described in the view dictionary. Test drives are there with --scenarios, or
    if the query names the column source. A query can read the warehouse, and nothing else. A table
    shows what fits of columns and rows; --all shows all. --csv, --json and --output give numbers to
    the last digit. Several statements on stdin are answered one after the other.

    Example: **fleet-slip sql "SELECT vehicle_id, count(*) AS drives FROM drives GROUP BY ALL"**
    """
    fleet: Fleet = context.obj
    if query == "-" and sys.stdin is not None and sys.stdin.isatty():
        raise UsageError('give a query: fleet-slip sql "FROM drives"; or pipe statements to it.')
    try:
        text = sys.stdin.read() if query == "-" else query
    except UnicodeDecodeError:
        raise QuestionError("the query on stdin is not UTF-8 text.") from None
    if not unsafe:
        limit_memory()
    opened = (fleet.unlocked_session if unsafe else fleet.session)(text, scenarios=scenarios)
    with opened as session:
        if output is not None:
            _write(session, text, output, limit, exact)
            return
        form = Form.JSON if json else Form.CSV if csv else Form.TABLE
        several = query == "-" and not unsafe
        for statement in split_statements(session.database, text) if several else [text]:
            answer(session, statement, form, exact=exact, limit=limit, everything=everything)


class Form(StrEnum):
    """How an answer is printed."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"


def answer(
    session: Session,
    text: str,
    form: Form,
    *,
    exact: bool = False,
    limit: int | None = None,
    everything: bool = False,
) -> None:
    """Print the answer to a query, or `limit` rows; `exact` leaves texts of CSV as they are."""
    with _representation_errors():
        if form is Form.TABLE:
            _show(session, text, limit, everything)
        elif form is Form.JSON:
            print_json(_rows(session, text, limit).to_pylist())
        else:
            rows = _rows(session, text, limit)
            sys.stdout.flush()
            write_csv(rows if exact else _mark_formulas(rows), sys.stdout.buffer)
            sys.stdout.buffer.flush()


def _rows(session: Session, text: str, limit: int | None) -> pa.Table:
    if limit is None:
        return session.table(text)
    return session.compute(text, lambda answer: answer.limit(limit).to_arrow_table())


def _write(session: Session, text: str, file: Path, limit: int | None, exact: bool) -> None:
    """Write an answer as the suffix says. Raises `UsageError` for another, and `StorageError`."""
    if file.suffix not in {".parquet", ".csv", ".json"}:
        raise UsageError(f"{file}: the suffix says the format: .parquet, .csv or .json.")
    rows = _rows(session, text, limit)
    try:
        with _representation_errors():
            if file.suffix == ".parquet":
                import pyarrow.parquet as pq  # noqa: PLC0415 - takes a while

                pq.write_table(rows, file)
            elif file.suffix == ".csv":
                write_csv(rows if exact else _mark_formulas(rows), file)
            else:
                file.write_text(json_text(rows.to_pylist()), "utf-8")
    except OSError as error:
        raise StorageError(f"{file}: {error.strerror or error}.") from None
    say(f"{file}: {number_of(rows.num_rows, 'row')}, {file.stat().st_size:,} bytes")


def _show(session: Session, text: str, limit: int | None, everything: bool) -> None:
    """Print what fits of an answer, and say what is left out and how to see it."""
    if limit is None and not everything and _DICTIONARY.fullmatch(text):
        _print_dictionary(session)
        return
    screen = shutil.get_terminal_size((160, 40)).columns
    width = ENDLESS if everything else screen
    rows = limit if limit is not None else ENDLESS if everything else ROWS_SHOWN
    shown, empty = session.compute(
        text, lambda answer: _fitting(answer if limit is None else answer.limit(limit), width, rows)
    )
    wide = shown.index("\n") > screen and shown.count("\n") <= ROWS_FOLDED
    if everything and sys.stdout.isatty() and wide:
        _print_folded(session, text, limit)
        return
    typer.echo(shown)
    if found := _CUT.search(shown):
        left_out = [f"{int(found[1]) - int(found[2])} of {found[1]} columns do not fit"]
        left_out += [f"without a value: {', '.join(empty)}"] if empty else []
        say(f"{'; '.join(left_out)}. Name those to see: SELECT …; all: --all")
    elif empty:
        say(f"columns without a value in these rows are left out: {', '.join(empty)}")
    elif left_out := [what for what, cut in _CUTS.items() if cut.search(shown)]:
        say(f"{' and '.join(left_out)}; whole: --all")


_DICTIONARY = re.compile(r"(?i)\s*from\s+dictionary\s*;?\s*")


def _print_dictionary(session: Session) -> None:
    """Print what every column is, view by view and whole."""
    rows = session.table('SELECT view, "column", unit, description FROM dictionary').to_pylist()
    for view, columns in groupby(rows, itemgetter("view")):
        cells = [[cell(one[key]) for key in ("column", "unit", "description")] for one in columns]
        print_table(f"{view}:", ["column", "unit", "description"], cells, left=3)
    say("types, too: fleet-slip sql --all \"FROM dictionary WHERE view = 'log'\"")


def _print_folded(session: Session, text: str, limit: int | None) -> None:
    """Print an answer that is wider than the terminal, with texts of several lines."""
    rows = session.compute(
        text,
        lambda answer: _readable(answer if limit is None else answer.limit(limit)).fetchall(),
    )
    names = session.compute(text, lambda answer: answer.columns)
    print_table("", names, [[cell(value) for value in row] for row in rows], left=len(names))


_CUTS = {
    "not all columns are shown": re.compile(r"│ … │"),  # a narrow table has no room to say so
    "not all rows are shown": re.compile(r"rows .*shown\)"),
    "long texts are cut": re.compile(r"\S… │"),
}
_CUT = re.compile(r"(\d+) columns \((\d+) shown\)")
_NOTHING_FITS, _HIDDEN = "┌───┐\n│ … │", "│ … │\n"
FEW_COLUMNS = 3
"""So many have room side by side, whatever they hold."""


def _fitting(answer: duckdb.DuckDBPyRelation, width: int, rows: int) -> tuple[str, list[str]]:
    """Return a table, and the columns that it is without: what has no value gives way to others."""
    answer = _readable(answer)
    shown = _drawn(answer, width, rows)
    if not _CUT.search(shown):
        return shown, []
    sample = answer.limit(ROWS_SHOWN).to_arrow_table()
    empty = [name for name in sample.column_names if sample[name].null_count == len(sample)]
    kept = [name for name in sample.column_names if name not in empty]
    if not empty or not kept or len(set(sample.column_names)) < len(sample.column_names):
        return shown, []
    names = ", ".join('"' + name.replace('"', '""') + '"' for name in kept)
    return _drawn(answer.project(names), width, rows), empty


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
    # A text as wide as all leaves other columns no room, or has none itself.
    for longest in (width, width // max(2, len(answer.columns)) - 3):
        with contextlib.redirect_stdout(io.StringIO()) as drawn:
            answer.show(max_rows=rows, max_width=width, max_col_width=longest)
        shown = drawn.getvalue()
        few = len(answer.columns) <= FEW_COLUMNS and _HIDDEN in shown
        if not few and not shown.startswith(_NOTHING_FITS):
            break
    return drawn.getvalue().rstrip("\n")


def _mark_formulas(answer: pa.Table) -> pa.Table:
    """Put an apostrophe before texts that a spreadsheet would take for formulas, and say so.

    Logs of others may hold names such as `=HYPERLINK(…)`. After OWASP, "CSV Injection".
    """
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
            f"the result cannot be printed: {error}. Cast the column, such as: CAST(sums AS TEXT)"
        ) from None
