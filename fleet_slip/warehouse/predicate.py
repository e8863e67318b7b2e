"""Predicates of users and manifests: SQL expressions on the columns of a drive or row.

A predicate becomes part of statements that run unattended for years. So it is parsed by itself
first. It must be one expression of permitted columns, constants, and deterministic operators and
functions: no subquery, random number or clock. Statements contain the parser's output, not the
user's text.
"""

import contextlib
import difflib
import functools
import json
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING, Any

from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import ALL_DRIVES, SCENARIO, TRAINING_DRIVES, SignalCatalog
from fleet_slip.errors import QuestionError, StorageError, printable
from fleet_slip.warehouse.database import (
    LONGEST_QUERY,
    RESTORE,
    Tree,
    allowed_words,
    duckdb_message,
    nodes_of,
    open_scratch,
    reading_files,
)

if TYPE_CHECKING:
    import duckdb


_POSITION_KEYS = frozenset({"query_location", "query_location_length"})

_QUERY = "SELECT 1 FROM drives WHERE "


@dataclass(frozen=True)
class Predicate:
    """A checked predicate; `parse_predicate` makes it.

    Attributes
    ----------
    text
        The user's text, for messages and manifests.
    sql
        The parser's output in parentheses, for statements.
    """

    text: str
    sql: str

    def __str__(self) -> str:
        """Return the user's text."""
        return self.text

    @property
    def quoted(self) -> str:
        """The text in quotes for messages, with the number of excluded drives, not their hashes."""
        cohort, excluded = _split_excluded(self.text)
        return f"{cohort!r}{excluded}"

    @property
    def columns(self) -> frozenset[str]:
        """The columns in it."""
        return columns_of(_expression(self.sql, self.text))

    def __and__(self, other: "Predicate") -> "Predicate":
        """Return the conjunction of two predicates."""
        conjunction = f"({self.sql} AND {other.sql})"
        return Predicate(conjunction, conjunction)


@contextlib.contextmanager
def guarded_query(database: "duckdb.DuckDBPyConnection", predicate: Predicate) -> Iterator[None]:
    """Translate the errors of a query with a predicate."""
    doing = f"the cohort {predicate.quoted}"
    try:
        with reading_files(database, doing):
            yield
    except StorageError as error:
        if not str(error).startswith(f"{doing} failed: Invalid Input Error"):
            raise
        # All files are sound.
        text = str(error).replace(" failed: ", " cannot be evaluated: ", 1)
        raise QuestionError(text.removesuffix(f" {RESTORE}")) from None


def parse_predicate(
    signals: SignalCatalog, text: str | Predicate, columns: Collection[str] | None = None
) -> Predicate:
    """Parse a predicate on columns, by default those of drives. Raises `QuestionError`."""
    if isinstance(text, Predicate):
        return text
    return _parse_cached(text, frozenset(drive_columns(signals) if columns is None else columns))


def parse_cohort(
    signals: SignalCatalog, text: str | Predicate, columns: Collection[str] | None = None
) -> Predicate:
    """Parse the predicate of a cohort; exclude evaluation drives unless it refers to them.

    It refers to them if it contains the column `source` or the word scenario. Raises
    `QuestionError`.
    """
    predicate = parse_predicate(signals, text, columns)
    if "source" in predicate.columns or SCENARIO in predicate.sql:
        return predicate
    return Predicate(predicate.text, f"({predicate.sql} AND {TRAINING_DRIVES})")


def drive_columns(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the columns of cohort predicates: a drive's metadata and its day."""
    return (*signals.drive, "day")


def row_columns(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the columns of predicates on rows of the view `log`."""
    columns = (signal.column for signal in signals.signals.values())
    return (*drive_columns(signals), "tick", "time_s", *columns)


@functools.lru_cache(maxsize=256)
def _parse_cached(text: str, columns: frozenset[str]) -> Predicate:
    quoted = f"the predicate {printable(text[:200])!r}"
    if len(text) > LONGEST_QUERY:
        raise QuestionError(
            f"{quoted} … has {len(text):,} characters, at most {LONGEST_QUERY:,} are read."
        )
    try:
        tree = _expression(text, quoted)
        for problem in problems(tree, columns):
            raise QuestionError(f"{quoted} {problem}")
        sql = _deparse(tree)
        if sql is None or _normalized(_expression(sql, quoted)) != _normalized(tree):
            raise QuestionError(f"{quoted} is too complex. Simplify it.")
    except RecursionError:
        raise QuestionError(f"{quoted} is nested too deeply. Simplify it.") from None
    return Predicate(text, f"({sql})")


def _expression(text: str, quoted: str) -> Tree:
    """Return the parsed expression of a predicate, which must be one expression.

    It is parsed alone and in parentheses. A text that closes a parenthesis fails alone; a text that
    continues after the expression (LIMIT, UNION, a second statement) fails in parentheses.
    """
    alone, enclosed = _parse(f"{text}\n", quoted), _parse(f"(\n{text}\n)", quoted)
    template = _parse("true", quoted)
    if alone != enclosed or {**alone, "where_clause": None} != {**template, "where_clause": None}:
        raise QuestionError(f"{quoted} is not one SQL expression.")
    expression: Tree = alone["where_clause"]
    return expression


def _parse(text: str, quoted: str) -> Tree:
    import duckdb

    try:
        (serialised,) = _run_scratch("SELECT json_serialize_sql($text::VARCHAR)", _QUERY + text)
    except (UnicodeEncodeError, duckdb.Error) as error:
        raise QuestionError(f"{quoted} is not valid SQL: {duckdb_message(error)}.") from None
    answer = json.loads(serialised, object_hook=_without_positions)
    if answer["error"]:
        reason = " ".join(str(answer.get("error_message")).split())
        raise QuestionError(f"{quoted} is not valid SQL: {reason}.")
    if len(answer["statements"]) != 1:
        raise QuestionError(f"{quoted} is not one SQL expression.")
    node: Tree = answer["statements"][0]["node"]
    return node


def _without_positions(node: dict[str, Any]) -> dict[str, Any]:
    """Return a parsed node without positions in the text."""
    return {key: value for key, value in node.items() if key not in _POSITION_KEYS}


def _normalized(value: Any) -> Any:
    """Return a tree in which operators and the functions of the same name are equal."""
    if isinstance(value, dict):
        return {key: _normalized(child) for key, child in value.items() if key != "is_operator"}
    return [_normalized(child) for child in value] if isinstance(value, list) else value


def _deparse(tree: Tree) -> str | None:
    """Return the SQL of a parsed expression; None if the parser cannot write it."""
    import duckdb

    (template,) = _run_scratch("SELECT json_serialize_sql($text::VARCHAR)", f"{_QUERY}true")
    query = json.loads(template)
    query["statements"][0]["node"]["where_clause"] = tree
    try:
        (text,) = _run_scratch("SELECT json_deserialize_sql($text::JSON)", json.dumps(query))
    except duckdb.Error:
        return None
    text = str(text)
    return text.removeprefix(_QUERY) if text.startswith(_QUERY) else None


def _run_scratch(statement: str, text: str) -> tuple[Any, ...]:
    with open_scratch() as database:
        [row] = database.execute(statement, {"text": text}).fetchall()
    return tuple(row)


# Predicates that exclude drives by hash, as their names must not be stored.

HASH_CHARACTERS = 16


def hash_drive(model: str, drive_id: str) -> str:
    """Return `left(sha256('MODEL ' || drive_id), 16)`, which replaces a drive's name."""
    return sha256(f"{model} {drive_id}".encode()).hexdigest()[:HASH_CHARACTERS]


def without_drives(cohort: str, model: str, hashes: Iterable[str]) -> str:
    """Return a predicate that also excludes the drives of these hashes."""
    listed = ", ".join(f"'{digest}'" for digest in sorted(hashes))
    if not listed:
        return cohort
    return (
        f"({cohort}) AND left(sha256('{model} ' || drive_id), {HASH_CHARACTERS}) NOT IN ({listed})"
    )


_EXCLUDED = re.compile(
    r"\((.*)\) AND left\(sha256\('[^']*' \|\| drive_id\), \d+\) NOT IN \(([^()]*)\)", re.DOTALL
)


def with_all_drives(cohort: str) -> str:
    """Return a predicate as before `without_drives`."""
    return _split_excluded(cohort)[0]


def describe_cohort(cohort: str) -> str:
    """Return a cohort for display after a number of drives: ` of NAME`, ` where PREDICATE`.

    Contains the number of excluded drives, not their hashes.
    """
    predicate, excluded = _split_excluded(cohort)
    if predicate in (ALL_DRIVES, TRAINING_DRIVES):
        return excluded
    campaign = _CAMPAIGN.fullmatch(predicate)
    return (f" of {campaign[1]}" if campaign else f" where {predicate}") + excluded


_CAMPAIGN = re.compile(r"campaign = '([^']*)'")
"""Matches the cohort of a pipeline: the drives of one campaign or mapping."""


def _split_excluded(cohort: str) -> tuple[str, str]:
    """Return a predicate without its exclusions, and a text with the number of excluded drives."""
    number = 0
    while match := _EXCLUDED.fullmatch(cohort):
        cohort, number = match[1], number + 1 + match[2].count(",")
    return cohort, f", without {pluralize(number, 'faulty drive')}" if number else ""


# What a predicate may contain: `warehouse/functions.toml` lists its functions, operators and types.


def problems(tree: Tree, columns: frozenset[str]) -> Iterator[str]:
    """Yield the violations of an expression, as the end of a sentence on the predicate."""
    for node in nodes_of(tree):
        if problem := _problem(node, columns):
            yield problem


def columns_of(tree: Tree) -> frozenset[str]:
    """Return the columns that a valid expression reads."""
    return frozenset(
        name.lower()
        for node in nodes_of(tree)
        if node.get("class") == "COLUMN_REF"
        for name in node["column_names"]
    )


def _problem(node: Tree, columns: frozenset[str]) -> str | None:
    kind, allowed = node.get("class"), allowed_words()["predicate"]
    if kind is None:
        return None
    if kind not in allowed["expressions"] or (
        kind == "OPERATOR" and node["type"] not in allowed["conditions"]
    ):
        construct = str(node["type"]).replace("_", " ").lower()
        return f"may not contain {construct}. Columns, constants, operators and functions may."
    if kind == "COLUMN_REF":
        return _column_problem(node, columns)
    if kind == "FUNCTION":
        return _function_problem(node)
    if kind == "TYPE" and (node["type_name"].upper() not in allowed["types"] or node["schema"]):
        quoted_name = printable(node["type_name"])
        return f"casts to {quoted_name!r}. It may cast to: {', '.join(sorted(allowed['types']))}."
    return None


def _column_problem(node: Tree, columns: frozenset[str]) -> str | None:
    names = node["column_names"]
    if len(names) == 1 and names[0].lower() in columns:
        return None
    quoted_name = printable(".".join(map(str, names)))
    nearest = difflib.get_close_matches(quoted_name.lower(), columns, n=1)
    hint = f" Did you mean {nearest[0]}?" if nearest else ""
    return f"has an unknown column {quoted_name!r}.{hint} Columns: {', '.join(sorted(columns))}."


def _function_problem(node: Tree) -> str | None:
    name = str(node["function_name"]).lower()
    allowed = allowed_words()["predicate"]
    plain = not (node["schema"] or node["catalog"] or node["filter"] or node["distinct"])
    if (
        name in allowed["functions"] | allowed["operators"]
        and plain
        and not node["order_bys"]["orders"]
    ):
        return None
    return (
        f"calls {printable(name)!r}. A predicate must always mean the same, so it may call only: "
        f"{', '.join(sorted(allowed['functions']))}."
    )
