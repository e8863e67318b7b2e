"""What a condition may be made of: expressions that mean the same everywhere and for ever."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from fleet_slip.errors import printable

Tree = Mapping[str, Any]
"""An expression as DuckDB's parser serialises it."""

_EXPRESSIONS = frozenset(
    {
        "BETWEEN",
        "CASE",
        "CAST",
        "COLUMN_REF",
        "COMPARISON",
        "CONJUNCTION",
        "CONSTANT",
        "FUNCTION",
        "OPERATOR",
        "TYPE",
    }
)
"""Kinds of expressions, as DuckDB calls them; others are subqueries, windows, lambdas, stars …"""

_OPERATORS = frozenset(
    {
        "COMPARE_IN",
        "COMPARE_NOT_IN",
        "OPERATOR_COALESCE",
        "OPERATOR_IS_NOT_NULL",
        "OPERATOR_IS_NULL",
        "OPERATOR_NOT",
    }
)

_SYMBOLS = frozenset({"+", "-", "*", "/", "//", "%", "||", "~~", "!~~", "~~*", "!~~*", "~~~"})
"""Operators that are functions to DuckDB; the last ones are LIKE, ILIKE and GLOB."""

FUNCTIONS = frozenset(
    re.findall(
        r"\w+",
        """
        abs ceil ceiling floor greatest least mod nullif round sign sqrt trunc
        contains ends_with left length lower ltrim prefix right rtrim split_part starts_with strpos
        substr substring suffix trim upper
        regexp_full_match regexp_matches like_escape not_like_escape ilike_escape not_ilike_escape
        list_value md5 sha256
        date_diff date_part date_trunc datediff datepart datetrunc day dayofmonth dayofweek
        dayofyear isodow isoyear make_date month quarter week weekday weekofyear year yearweek
        to_days to_months to_weeks to_years
        """,
    )
)
"""Functions of their arguments alone, the same on every machine and in every version of DuckDB.

None makes a text longer than its arguments together, so that the cost of a condition is bounded by
its length. `to_days` and its like are what INTERVAL becomes, `list_value` is a list in brackets."""

TYPES = frozenset(
    re.findall(
        r"\w+",
        "BOOLEAN TINYINT SMALLINT INTEGER BIGINT HUGEINT FLOAT DOUBLE DECIMAL VARCHAR DATE",
    )
)
"""What may be cast to. Not a time with a zone: the zone is the machine's."""


def problems(tree: Tree, columns: frozenset[str]) -> Iterator[str]:
    """Yield what is not allowed in an expression on some columns, as what a condition does."""
    for node in _nodes(tree):
        if problem := _problem(node, columns):
            yield problem


def columns_of(tree: Tree) -> frozenset[str]:
    """Return the columns that an expression without problems asks for."""
    return frozenset(
        name.lower()
        for node in _nodes(tree)
        if node.get("class") == "COLUMN_REF"
        for name in node["column_names"]
    )


def _nodes(value: Any) -> Iterator[Tree]:
    if isinstance(value, dict):
        yield value
        for part in value.values():
            yield from _nodes(part)
    elif isinstance(value, list):
        for part in value:
            yield from _nodes(part)


def _problem(node: Tree, columns: frozenset[str]) -> str | None:
    kind = node.get("class")
    if kind is None:
        return None
    if kind not in _EXPRESSIONS or (kind == "OPERATOR" and node["type"] not in _OPERATORS):
        what = str(node["type"]).replace("_", " ").lower()
        return f"may not have this in it: {what}. Columns, constants, operators and functions may."
    if kind == "COLUMN_REF":
        return _column_problem(node, columns)
    if kind == "FUNCTION":
        return _function_problem(node)
    if kind == "TYPE" and (node["type_name"].upper() not in TYPES or node["schema"]):
        named = printable(node["type_name"])
        return f"casts to {named!r}. It may cast to: {', '.join(sorted(TYPES))}."
    return None


def _column_problem(node: Tree, columns: frozenset[str]) -> str | None:
    names = node["column_names"]
    if len(names) == 1 and names[0].lower() in columns:
        return None
    named = printable(".".join(map(str, names)))
    return f"names the column {named!r}. Columns: {', '.join(sorted(columns))}."


def _function_problem(node: Tree) -> str | None:
    name = str(node["function_name"]).lower()
    plain = not (node["schema"] or node["catalog"] or node["filter"] or node["distinct"])
    if name in FUNCTIONS | _SYMBOLS and plain and not node["order_bys"]["orders"]:
        return None
    return (
        f"calls {printable(name)!r}. A condition must mean the same for ever, so it may call "
        f"only: {', '.join(sorted(FUNCTIONS))}."
    )
