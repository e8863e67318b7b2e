"""The command that asks the warehouse a query: sql."""

import contextlib
import io
import logging
import re
import shutil
import sys
from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import typer
from pyarrow.csv import write_csv

from fleet_slip.api.fleet import Fleet
from fleet_slip.api.session import Session
from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.errors import QuestionError
from fleet_slip.warehouse.database import limit_memory

ROWS_SHOWN = 40
FORMULA = "^[=+@\\t\\r\\n＝＋－＠-]"
"""What a text begins with that a spreadsheet executes."""


def sql(
    context: typer.Context,
    query: Annotated[
        str, typer.Argument(help='SQL, such as "FROM drives LIMIT 5". - reads it from stdin.')
    ],
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

    Every column is described in the view dictionary. A query can read the warehouse, and nothing
    else. A table shows the columns that fit; name some to see others, or ask for --csv or --json.

    Example: **fleet-slip sql "SELECT vehicle_id, count(*) AS drives FROM drives GROUP BY ALL"**
    """
    fleet: Fleet = context.obj
    try:
        text = sys.stdin.read() if query == "-" else query
    except UnicodeDecodeError:
        raise QuestionError("the query on stdin is not UTF-8 text.") from None
    if not unsafe:
        limit_memory()
    opened = (fleet.unlocked_session if unsafe else fleet.session)(text)
    with opened as session:
        answer(session, text, Form.JSON if json else Form.CSV if csv else Form.TABLE, exact=exact)


class Form(StrEnum):
    """How an answer is printed."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"


def answer(session: Session, text: str, form: Form, *, exact: bool = False) -> None:
    """Print the answer to a query; `exact` leaves texts of CSV as they are."""
    with _representation_errors():
        if form is Form.TABLE:
            _show(session, text)
        elif form is Form.JSON:
            print_json(session.table(text).to_pylist())
        else:
            rows = session.table(text)
            sys.stdout.flush()
            write_csv(rows if exact else _mark_formulas(rows), sys.stdout.buffer)
            sys.stdout.buffer.flush()


def _show(session: Session, text: str) -> None:
    """Print what fits of an answer, and say what is left out and how to see it."""
    width = shutil.get_terminal_size((160, 40)).columns
    shown, empty = session.compute(text, lambda answer: _fitting(answer, width))
    typer.echo(shown)
    if found := _CUT.search(shown):
        left_out = [f"{int(found[1]) - int(found[2])} of {found[1]} columns do not fit"]
        left_out += [f"without a value: {', '.join(empty)}"] if empty else []
        say(f"{'; '.join(left_out)}. Name those to see: SELECT …; all: --csv or --json")
    elif empty:
        say(f"columns without a value in these rows are left out: {', '.join(empty)}")


_CUT = re.compile(r"(\d+) columns \((\d+) shown\)")


def _fitting(answer: duckdb.DuckDBPyRelation, width: int) -> tuple[str, list[str]]:
    """Return a table, and the columns that it is without: what has no value gives way to others."""
    shown = _drawn(answer, width)
    if not _CUT.search(shown):
        return shown, []
    sample = answer.limit(ROWS_SHOWN).to_arrow_table()
    empty = [name for name in sample.column_names if sample[name].null_count == len(sample)]
    kept = [name for name in sample.column_names if name not in empty]
    if not empty or not kept or len(set(sample.column_names)) < len(sample.column_names):
        return shown, []
    names = ", ".join('"' + name.replace('"', '""') + '"' for name in kept)
    return _drawn(answer.project(names), width), empty


def _drawn(answer: duckdb.DuckDBPyRelation, width: int) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as drawn:
        answer.show(max_rows=ROWS_SHOWN, max_width=width)
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
