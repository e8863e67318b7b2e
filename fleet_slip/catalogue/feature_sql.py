"""The integer SQL of features: what may stand in it, and the queries that compute it."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from fleet_slip.catalogue.signals import COUNT_MAX, catalogue

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FUNCTIONS = frozenset({"abs", "sign"})


@dataclass(frozen=True)
class _Grammar:
    words: frozenset[str]
    """What may stand beside the names of signals."""
    characters: re.Pattern[str]
    described: str


_DECLARED = _Grammar(
    _FUNCTIONS, re.compile(r"[a-z0-9_+\-*() ]+"), "integer arithmetic of + - * ( )"
)
"""What `configs/features.toml` may say."""

_GENERATED = _Grammar(
    _FUNCTIONS | {"CASE", "WHEN", "THEN", "ELSE", "END", "BIGINT"},
    re.compile(r"(?!.*--|.*/\*)[A-Za-z0-9_+*/()<>=: -]{0,5000}"),
    "integer arithmetic on the counts of signals",
)
"""What that becomes: division that rounds, guarded against small divisors, in 64 bits."""


def names_in(text: str) -> set[str]:
    """Return the words of an expression: names of signals and functions."""
    return set(_WORD.findall(text))


def integer_sql(text: str) -> str:
    """Return a declared expression over counts with every signal widened to 64 bits.

    Raises `ValueError` for anything but integer arithmetic on input signals.
    """
    inputs = catalogue().inputs
    _require(text, _DECLARED, inputs)
    return _WORD.sub(lambda m: f"{m[0]}::BIGINT" if m[0] in inputs else m[0], text)


def require_integer_sql(sql: str) -> str:
    """Return the SQL of a feature. Raises `ValueError` if it is more than integer arithmetic.

    A manifest may come from anywhere, and this is the one text of it that becomes SQL.
    """
    _require(sql, _GENERATED, catalogue().signals)
    return sql


def _require(text: str, grammar: _Grammar, signals: Collection[str]) -> None:
    unknown = sorted(names_in(text) - grammar.words - set(signals))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: not an input signal, abs or sign")
    if not grammar.characters.fullmatch(text):
        raise ValueError(f"{text!r} is not {grammar.described}")


def with_absent(rows: str, absent: Sequence[str]) -> str:
    """Return a table expression with signals that none of its files has, as nulls."""
    if not absent:
        return rows
    nulls = ", ".join(f"NULL::SMALLINT AS {name}" for name in absent)
    return f"(SELECT *, {nulls} FROM {rows})"


def with_features(rows: str, definitions: Mapping[str, str]) -> str:
    """Return a subquery: the rows with features as columns of counts, clipped to int16.

    `rows` is a table expression with counts; `definitions` gives the SQL of each feature. The
    column `clipped` says how many of the features of a row were out of range.
    """
    if not definitions:
        return rows
    separator = ",\n            "
    computed = separator.join(f"{sql} AS {name}" for name, sql in definitions.items())
    inside = separator.join(f"{clipped_sql(name)} AS {name}" for name in definitions)
    outside = " + ".join(
        f"coalesce(abs({name}) > {COUNT_MAX}, false)::INTEGER" for name in definitions
    )
    return f"""(
        SELECT * REPLACE (
            {inside}
        ),
            {outside} AS clipped
        FROM (
            SELECT *,
            {computed}
            FROM {rows}
        )
    )"""


def clipped_sql(name: str) -> str:
    """Return the SQL of an integer column clipped to the range of counts; null stays null."""
    return (
        f"CASE WHEN {name} > {COUNT_MAX} THEN {COUNT_MAX} "
        f"WHEN {name} < -{COUNT_MAX} THEN -{COUNT_MAX} ELSE {name} END::SMALLINT"
    )
