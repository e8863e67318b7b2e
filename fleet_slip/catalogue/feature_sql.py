"""The integer SQL of features: what may stand in it."""

import re
from collections.abc import Collection
from dataclasses import dataclass

from fleet_slip.catalogue.signals import catalogue

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FUNCTIONS = frozenset({"abs", "sign"})


@dataclass(frozen=True)
class _Grammar:
    words: frozenset[str]
    """What may stand beside the names of signals."""
    characters: re.Pattern[str]
    described: str


_DECLARED = _Grammar(
    _FUNCTIONS,
    re.compile(r"(?:[a-z0-9_+\-*() ]|// [1-9][0-9]*(?![0-9]))+"),
    "integer arithmetic of + - * ( ) and // NUMBER",
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
    inputs = catalogue().feature_inputs
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
