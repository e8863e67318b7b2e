"""What each operation is in SQL: plain SQL of many engines, and what DuckDB writes otherwise.

Null is a missing value. Integers have 64 bits.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence

from fleet_slip.catalogue.arithmetic import nearest_sql
from fleet_slip.catalogue.definitions import LARGEST_FACT
from fleet_slip.columns.lowering import CarFact
from fleet_slip.columns.operations import (
    GIVEN,
    OPERATIONS,
    Range,
    Step,
    operands_of,
    operation_of,
    plain_of,
)

QUOTIENT = "CAST(ROUND(({0} - {0} % {1}) / {1}) AS BIGINT)"
"""{0} / {1}, truncated; exact in floating point too: a small multiple of the divisor."""

_NEAREST = QUOTIENT.format("(2 * ABS({0}) + {1})", "(2 * {1})")

PLAIN_SQL: Mapping[str, str] = {
    "+": "({0} + {1})",
    "-": "({0} - {1})",
    "*": "({0} * {1})",
    "//": QUOTIENT,
    "nearest": f"(CASE WHEN {{0}} < 0 THEN -{_NEAREST} ELSE {_NEAREST} END)",
    "min": "(CASE WHEN {0} <= {1} THEN {0} WHEN {1} < {0} THEN {1} END)",
    "max": "(CASE WHEN {0} >= {1} THEN {0} WHEN {1} > {0} THEN {1} END)",
    "negative": "(-{0})",
    "abs": "ABS({0})",
    "sign": "(CASE WHEN {0} > 0 THEN 1 WHEN {0} < 0 THEN -1 ELSE 0 * {0} END)",
    "clip": "(CASE WHEN {0} > {1} THEN {1} WHEN {0} < -{1} THEN -{1} ELSE {0} END)",
    "at_least": "(CASE WHEN {0} >= {1} THEN {0} END)",
    "where": "(CASE WHEN {1} IS NOT NULL THEN {0} END)",
    "else": "COALESCE({0}, {1})",
    "ago": "MAX({0}) OVER ({drive} RANGE BETWEEN {1} PRECEDING AND {1} PRECEDING)",
    "sum": "CAST(COALESCE(SUM({0}) OVER ({drive} {frame}), 0) AS BIGINT)",
    "values": "COUNT({0}) OVER ({drive} {frame})",
}

DUCKDB_SQL: Mapping[str, str] = {
    **PLAIN_SQL,
    "//": "({0} // {1})",
    "nearest": f"({nearest_sql('{0}', '{1}')})",
    "sign": "sign({0})",
}

DIVIDES = ("//", "nearest")


def sql_constant(value: int) -> str:
    """Return a constant; a negative one may stand behind a minus."""
    return str(value) if value >= 0 else f"({value})"


def fact_sql(one: CarFact) -> str:
    """Return the whole number of a fact, given the column of the drive; null if not known."""
    if one.equals is None:
        known = f"ABS({one.name}) <= {LARGEST_FACT}"
        return f"CASE WHEN {known} THEN CAST(ROUND({one.name}) AS BIGINT) END"
    is_it = f"{one.name} = '{one.equals}'"
    return f"CASE WHEN {is_it} THEN 1 WHEN {one.name} IS NOT NULL THEN 0 END"


def sql_of(
    operation: str, operands: list[str], *plain: int, divides_by: int, table: Mapping[str, str]
) -> str:
    """Return an operation on operands in SQL; `divides_by` is the least that the divisor can be."""
    frame = f"RANGE BETWEEN {plain[0] - 1} PRECEDING AND CURRENT ROW" if plain and plain[0] else ""
    text = table[operation].format(
        *operands,
        *plain,
        drive="PARTITION BY drive_id ORDER BY tick",
        frame=frame or "RANGE BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW",
    )
    if operation in DIVIDES and divides_by <= 0:
        return f"(CASE WHEN {operands[1]} > 0 THEN {text} END)"
    return text


INLINE = ("+", "-", "*", "negative")
"""What may stand within another step, where it is used once."""


class SqlLayers:
    """The layers of steps; those that are asked for are written, with what they need.

    Attributes:
        layers: the columns of each, by its number from 1.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        ranges: Sequence[Range],
        table: Mapping[str, str],
        given: Callable[[str, int], str],
    ) -> None:
        self._steps, self._ranges, self._table, self._given = steps, ranges, table, given
        self.layers: defaultdict[int, list[str]] = defaultdict(list)
        self._uses = Counter(of for step in steps for of in operands_of(step))
        self._texts: dict[int, tuple[str, int]] = {}

    def text(self, number: int) -> tuple[str, int]:
        """Return a step in SQL, and the layer that has all columns in it."""
        if number not in self._texts:
            self._texts[number] = self._written(number)
        return self._texts[number]

    def column(self, number: int) -> tuple[str, int]:
        """Return a step as one word."""
        text, layer = self.text(number)
        if " " in text:
            self._texts[number] = self._named(number, text, layer)
        return self._texts[number]

    def _written(self, number: int) -> tuple[str, int]:
        step = self._steps[number]
        name, plain = operation_of(step), plain_of(step)
        if name == "constant":
            return sql_constant(plain[0]), 0
        if name in GIVEN:
            return self._given(name, plain[0]), 0
        one = OPERATIONS[name]
        own = plain[: one.steps]
        inline = name in INLINE
        parts = [self.text(i) if inline else self.column(i) for i in own]
        text = sql_of(
            name,
            [part for part, _ in parts],
            *plain[one.steps :],
            divides_by=self._ranges[own[-1]][0],
            table=self._table,
        )
        layer = max(layer for _, layer in parts)
        if inline and self._uses[number] == 1:
            return text, layer
        return self._named(number, text, layer)

    def _named(self, number: int, text: str, layer: int) -> tuple[str, int]:
        self.layers[layer + 1].append(f"{text} AS step_{number}")
        return f"step_{number}", layer + 1
