"""Conditions that people write and manifests keep: one SQL expression on a drive's columns each.

A condition becomes part of statements that nobody looks at, tonight and in years. So it is parsed
by itself, before it stands in any of them, and must be one expression made of the columns that it
is about, constants, and operators and functions whose value depends on their arguments alone: no
subquery, no random number, no clock. What stands in statements is not its text but what the parser
understood, written out again.
"""

import contextlib
import functools
import json
import re
import threading
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import duckdb

from fleet_slip.base import number_of
from fleet_slip.catalog.drive_sources import SCENARIO, TRAINING_DRIVES
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import QuestionError, StorageError, printable
from fleet_slip.warehouse.database import (
    LONGEST_QUERY,
    Tree,
    columns_of,
    duckdb_message,
    open_scratch,
    problems,
    reading_files,
)

LONGEST_S = 3600.0
"""No condition is asked for longer: what a manifest keeps is read by jobs that nobody watches."""

_PLACES = frozenset({"query_location", "query_location_length"})

_QUERY = "SELECT 1 FROM drives WHERE "


@dataclass(frozen=True)
class Condition:
    """A condition that has passed; `parse_condition` makes it.

    Attributes:
        text: as it was written, which people are shown and manifests keep.
        sql: the same, written out by the parser in parentheses, which stands in statements.
    """

    text: str
    sql: str

    def __str__(self) -> str:
        """Return it as it was written."""
        return self.text

    @property
    def shown(self) -> str:
        """What messages call it: its text in quotes, without the hashes of drives left out."""
        cohort, left_out = _left_out_of(self.text)
        return f"{cohort!r}{left_out}"

    @property
    def columns(self) -> frozenset[str]:
        """The columns that it asks for."""
        return columns_of(_expression(self.sql, self.text))

    def __and__(self, other: "Condition") -> "Condition":
        """Return the condition that both are true."""
        both = f"({self.sql} AND {other.sql})"
        return Condition(both, both)


@contextlib.contextmanager
def asking(
    database: duckdb.DuckDBPyConnection, condition: Condition, limit_s: float = LONGEST_S
) -> Iterator[None]:
    """Turn the errors of a query with a condition into ours, and end it when it takes too long.

    Not for two queries of a connection at once. Raises `QuestionError` once the time is over.
    """
    over = threading.Event()

    def stop() -> None:
        over.set()
        database.interrupt()

    timer = threading.Timer(limit_s, stop)
    timer.daemon = True
    timer.start()
    try:
        with reading_files(database, f"the cohort {condition.shown}"):
            yield
    except StorageError as error:
        cause = error.__context__
        if isinstance(cause, duckdb.InvalidInputException):  # and every file is sound
            raise QuestionError(
                f"the cohort {condition.shown} cannot be evaluated: {duckdb_message(cause)}."
            ) from None
        raise
    except BaseException:
        if not over.is_set():
            raise
        raise QuestionError(
            f"the cohort {condition.shown} took more than {limit_s:g} s. Simplify it."
        ) from None
    finally:
        timer.cancel()


def parse_condition(
    signals: SignalCatalog, text: str | Condition, columns: Collection[str] | None = None
) -> Condition:
    """Return a condition on columns, by default of drives. Raises `QuestionError`."""
    if isinstance(text, Condition):
        return text
    return _parsed(text, frozenset(drive_columns(signals) if columns is None else columns))


def parse_cohort(
    signals: SignalCatalog, text: str | Condition, columns: Collection[str] | None = None
) -> Condition:
    """Return the condition of a cohort of the fleet: without test drives, unless it asks for them.

    It asks if it names the column `source`, or a scenario. Raises `QuestionError`.
    """
    condition = parse_condition(signals, text, columns)
    if "source" in condition.columns or SCENARIO in condition.sql:
        return condition
    return Condition(condition.text, f"({condition.sql} AND {TRAINING_DRIVES})")


def drive_columns(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the columns that the condition of a cohort may use: a drive's metadata and its day."""
    return (*signals.drive, "day")


def row_columns(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the columns that a condition on the rows of the view `log` may use."""
    columns = (signal.column for signal in signals.signals.values())
    return (*drive_columns(signals), "tick", "time_s", *columns)


@functools.lru_cache(maxsize=256)
def _parsed(text: str, columns: frozenset[str]) -> Condition:
    shown = f"the condition {printable(text[:200])!r}"
    if len(text) > LONGEST_QUERY:
        raise QuestionError(
            f"{shown} … has {len(text):,} characters, at most {LONGEST_QUERY:,} are read."
        )
    try:
        tree = _expression(text, shown)
        for problem in problems(tree, columns):
            raise QuestionError(f"{shown} {problem}")
        sql = _written(tree)
        if sql is None or _meaning(_expression(sql, shown)) != _meaning(tree):
            raise QuestionError(f"{shown} is too complex. Simplify it.")
    except RecursionError:
        raise QuestionError(f"{shown} is nested too deeply. Simplify it.") from None
    return Condition(text, f"({sql})")


def _expression(text: str, shown: str) -> Tree:
    """Return what the parser makes of a condition, which must be one expression by itself.

    It stands alone and in parentheses. What closes a parenthesis is no expression alone, and what
    goes on after the expression (LIMIT, UNION, a second statement) none in parentheses.
    """
    alone, enclosed = _parse(f"{text}\n", shown), _parse(f"(\n{text}\n)", shown)
    template = _parse("true", shown)
    if alone != enclosed or {**alone, "where_clause": None} != {**template, "where_clause": None}:
        raise QuestionError(f"{shown} is not one SQL expression.")
    found: Tree = alone["where_clause"]
    return found


def _parse(text: str, shown: str) -> Tree:
    try:
        (serialised,) = _ask("SELECT json_serialize_sql($text::VARCHAR)", _QUERY + text)
    except (UnicodeEncodeError, duckdb.Error) as error:
        raise QuestionError(f"{shown} is not valid SQL: {duckdb_message(error)}.") from None
    answer = json.loads(serialised, object_hook=_without_place)
    if answer["error"]:
        reason = " ".join(str(answer.get("error_message")).split())
        raise QuestionError(f"{shown} is not valid SQL: {reason}.")
    if len(answer["statements"]) != 1:
        raise QuestionError(f"{shown} is not one SQL expression.")
    node: Tree = answer["statements"][0]["node"]
    return node


def _without_place(node: dict[str, Any]) -> dict[str, Any]:
    """Return a node of the parsed text without where it stood."""
    return {key: value for key, value in node.items() if key not in _PLACES}


def _meaning(value: Any) -> Any:
    """Return a tree without whether functions were written as operators."""
    if isinstance(value, dict):
        return {key: _meaning(part) for key, part in value.items() if key != "is_operator"}
    return [_meaning(part) for part in value] if isinstance(value, list) else value


def _written(tree: Tree) -> str | None:
    """Return an expression as the parser writes it; None if it cannot."""
    (template,) = _ask("SELECT json_serialize_sql($text::VARCHAR)", f"{_QUERY}true")
    query = json.loads(template)
    query["statements"][0]["node"]["where_clause"] = tree
    try:
        (text,) = _ask("SELECT json_deserialize_sql($text::JSON)", json.dumps(query))
    except duckdb.Error:
        return None
    text = str(text)
    return text.removeprefix(_QUERY) if text.startswith(_QUERY) else None


def _ask(statement: str, text: str) -> tuple[Any, ...]:
    with open_scratch() as database:
        [row] = database.execute(statement, {"text": text}).fetchall()
    return tuple(row)


# Conditions that leave out drives by hashes, which say nothing of a drive's name.

HASH_CHARACTERS = 16


def hash_drive(model: str, drive_id: str) -> str:
    """Return `left(sha256('MODEL ' || drive_id), 16)`, which stands for a drive in the record."""
    return sha256(f"{model} {drive_id}".encode()).hexdigest()[:HASH_CHARACTERS]


def without_drives(cohort: str, model: str, hashes: Iterable[str]) -> str:
    """Return a condition that also leaves out the drives of these hashes."""
    listed = ", ".join(f"'{one}'" for one in sorted(hashes))
    if not listed:
        return cohort
    return (
        f"({cohort}) AND left(sha256('{model} ' || drive_id), {HASH_CHARACTERS}) NOT IN ({listed})"
    )


_LEFT_OUT = re.compile(
    r"\((.*)\) AND left\(sha256\('[^']*' \|\| drive_id\), \d+\) NOT IN \(([^()]*)\)", re.DOTALL
)


def with_all_drives(cohort: str) -> str:
    """Return a condition as it was before `without_drives` left out some."""
    return _left_out_of(cohort)[0]


def describe_cohort(cohort: str) -> str:
    """Return a condition for people, with the number of drives left out and not their hashes."""
    return "".join(_left_out_of(cohort))


def _left_out_of(cohort: str) -> tuple[str, str]:
    """Return a condition with all drives, and how many drives it leaves out, nothing if none."""
    number = 0
    while found := _LEFT_OUT.fullmatch(cohort):
        cohort, number = found[1], number + 1 + found[2].count(",")
    return cohort, f", without {number_of(number, 'faulty drive')}" if number else ""
