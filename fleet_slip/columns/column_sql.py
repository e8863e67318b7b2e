"""SQL of the operations and columns: plain SQL of many engines, and DuckDB's.

Null is a missing value. Integers have 64 bits.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from fleet_slip.catalog.arithmetic import Step, nearest_sql
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import MAX_ATTRIBUTE, Definition, rows_behind
from fleet_slip.catalog.signals import COUNT_MAX, SignalCatalog
from fleet_slip.columns.lowering import (
    GIVEN,
    POWERS,
    Lowering,
    Range,
    VehicleAttribute,
    size_of,
)
from fleet_slip.errors import DataError, QuestionError

QUOTIENT = "CAST(ROUND(({0} - {0} % {1}) / {1}) AS BIGINT)"
"""{0} / {1}, truncated. Exact in floating point too, as a small multiple of the divisor."""

_POWER = "(1 + 0 * {0}" + "".join(
    f" + CASE WHEN {{0}} > CAST({1 << bit} AS BIGINT) * {{1}} THEN {1 << bit} ELSE 0 END"
    for bit in range(POWERS)
)

_NEAREST = QUOTIENT.format("(2 * ABS({0}) + {1})", "(2 * {1})")

PLAIN_SQL: Mapping[str, str] = {
    "+": "({0} + {1})",
    "-": "({0} - {1})",
    "*": "({0} * {1})",
    "//": QUOTIENT,
    "nearest": f"(CASE WHEN {{0}} < 0 THEN -{_NEAREST} ELSE {_NEAREST} END)",
    "min": "(CASE WHEN {0} <= {1} THEN {0} WHEN {1} < {0} THEN {1} END)",
    "max": "(CASE WHEN {0} >= {1} THEN {0} WHEN {1} > {0} THEN {1} END)",
    "power": f"{_POWER})",
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


def attribute_sql(attribute: VehicleAttribute) -> str:
    """Return the SQL of a vehicle attribute's integer from the drive's column; null if unknown."""
    if attribute.equals is None:
        is_valid = f"ABS({attribute.name}) <= {MAX_ATTRIBUTE}"
        return f"CASE WHEN {is_valid} THEN CAST(ROUND({attribute.name}) AS BIGINT) END"
    is_it = f"{attribute.name} = '{attribute.equals}'"
    return f"CASE WHEN {is_it} THEN 1 WHEN {attribute.name} IS NOT NULL THEN 0 END"


def _frame(ticks: int = 0) -> str:
    """Return the frame of a window of so many ticks; of 0 ticks, of all since the start."""
    begin = f"{ticks - 1}" if ticks else "UNBOUNDED"
    return f"RANGE BETWEEN {begin} PRECEDING AND CURRENT ROW"


INLINE = ("+", "-", "*", "negative")
"""Operations that are inlined if used once."""


class SqlLayers:
    """Subquery layers of the requested steps and their operands.

    `layers` contains the columns of each layer, by its number from 1.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        ranges: Sequence[Range],
        table: Mapping[str, str],
        input_sql: Callable[[str, int], str],
    ) -> None:
        self._steps, self._ranges, self._table, self._input_sql = steps, ranges, table, input_sql
        self.layers: defaultdict[int, list[str]] = defaultdict(list)
        self._uses = Counter(operand for step in steps for operand in step.operands)
        self._texts: dict[int, tuple[str, int]] = {}

    def text(self, number: int) -> tuple[str, int]:
        """Return the SQL of a step, and the layer that defines its columns."""
        if number not in self._texts:
            self._texts[number] = self._written(number)
        return self._texts[number]

    def column(self, number: int) -> tuple[str, int]:
        """Return a step as the name of a column, and its layer."""
        text, layer = self.text(number)
        if " " in text:
            self._texts[number] = self._named(number, text, layer)
        return self._texts[number]

    def _written(self, number: int) -> tuple[str, int]:
        step = self._steps[number]
        if step.name == "constant":
            value = step.plain[0]  # in parentheses if negative: a minus may precede it
            return (str(value) if value >= 0 else f"({value})"), 0
        if step.name in GIVEN:
            return self._input_sql(step.name, step.plain[0]), 0
        inline = step.name in INLINE
        parts = [self.text(i) if inline else self.column(i) for i in step.operands]
        text = self._table[step.name].format(
            *(part for part, _ in parts),
            *step.plain,
            drive="PARTITION BY drive_id ORDER BY tick",
            frame=_frame(*step.plain[:1]),
        )
        if step.name in DIVIDES and self._ranges[step.operands[1]][0] <= 0:
            text = f"(CASE WHEN {parts[1][0]} > 0 THEN {text} END)"
        layer = max(layer for _, layer in parts)
        if inline and self._uses[number] == 1:
            return text, layer
        return self._named(number, text, layer)

    def _named(self, number: int, text: str, layer: int) -> tuple[str, int]:
        self.layers[layer + 1].append(f"{text} AS step_{number}")
        return f"step_{number}", layer + 1


# Lowering for the warehouse, which counts clipped values.
#
# It clips last, so that missing values are not counted. Exported programs clip first: same values.

LOGGED: Range = (-(2**15), 2**15 - 1)
"""Range of logged counts."""


class _ClippedLast(Lowering):
    def clip_where(self, step: int, limit: int, presence: Callable[[], int]) -> int:
        return self.clip(self.do("where", step, presence()), limit)


@dataclass(frozen=True)
class CountedColumns:
    """Steps of columns, with the weight of their clipping.

    Attributes
    ----------
    steps, ranges
        The steps of `lowered` in order, and their ranges.
    places
        The step of each column, by name.
    times
        Weight of a step's clipping: once per feature or column over time that contains it; once in
        all for gates and gated columns.
    """

    lowered: Lowering
    steps: tuple[Step, ...]
    ranges: list[Range]
    places: Mapping[str, int]
    times: Mapping[int, int]

    @classmethod
    def from_definitions(
        cls, rows: Mapping[str, Definition], over_time: Mapping[str, Definition]
    ) -> "CountedColumns":
        """Lower columns over time, and `rows`, which include their sources."""
        signals = dict.fromkeys(name for definition in rows.values() for name in definition.signals)
        lowered = _ClippedLast({name: place for place, name in enumerate(signals)})
        components, gated = list[Definition](), dict[Definition, None]()
        for definition in over_time.values():
            if definition.gate:
                gated |= dict.fromkeys(definition.components)
            else:
                components += definition.components
        components += gated
        places = {}
        for name, row in rows.items():  # each row is followed by the columns that use it
            places[name] = lowered.row(row)
            for component in components:
                if component.of == name:
                    lowered.column(component)
        columns = {name: lowered.column(definition) for name, definition in over_time.items()}
        steps = tuple(lowered.steps)
        ends = {*places.values()}
        times = Counter(places[name] for name, row in rows.items() if row.sql or row.made)
        for component in components:
            times.update(_clips(steps, lowered.column(component), ends))
        ranges = lowered.ranges([LOGGED] * len(signals))
        return cls(lowered, steps, ranges, places | columns, times)


def rows_of(
    rows: Mapping[str, Definition], over_time: Mapping[str, Definition]
) -> dict[str, Definition]:
    """Add the sources of columns to `rows`. Raises `QuestionError`, `DataError`."""
    merged = dict(rows)
    for name, row in rows_behind(over_time).items():
        if merged.setdefault(name, row) != row:
            raise DataError(f"the feature {name} is defined in two ways.")
    return merged


def _clips(steps: tuple[Step, ...], end: int, ends: Iterable[int]) -> set[int]:
    """Return the clipping steps between `ends` and a step."""
    clips, waiting = set[int](), [end]
    while waiting:
        number = waiting.pop()
        if number not in ends:
            clips |= {number} if steps[number].name == "clip" else set()
            waiting += steps[number].operands
    return clips


# SQL of columns as subqueries of `log_counts`.

_SEPARATOR = ",\n            "


def with_absent(signals: SignalCatalog, rows: str, absent: Sequence[str]) -> str:
    """Return a table expression with absent stored columns as nulls."""
    if not absent:
        return rows
    nulls = ", ".join(map(signals.null_sql, absent))
    return f"(SELECT *, {nulls} FROM {rows})"


def with_columns(
    rows: str, features: Mapping[str, Definition], over_time: Mapping[str, Definition]
) -> str:
    """Return a subquery that adds features and columns over time to rows.

    `clipped` counts the values of a row beyond their range. Raises `QuestionError` or `DataError`
    for a feature with two definitions.
    """
    if not features and not over_time:
        return rows
    all_rows = rows_of(features, over_time)
    counted = CountedColumns.from_definitions(all_rows, over_time)
    signals, facts = list(counted.lowered.signals), list(counted.lowered.facts)
    layers = SqlLayers(
        counted.steps,
        counted.ranges,
        DUCKDB_SQL,
        lambda name, place: (
            f"{signals[place]}::BIGINT" if name == "signal" else f"({attribute_sql(facts[place])})"
        ),
    )
    columns, clips = [], []
    for name, place in counted.places.items():
        if name not in signals:
            size = size_of(counted.ranges[place])
            kind = "SMALLINT" if size <= COUNT_MAX else "INTEGER"
            columns.append(f"{layers.column(place)[0]}::{kind} AS {name}")
    for place, times in counted.times.items():
        value, limit = counted.steps[place].operands
        largest = counted.steps[limit].plain[0]
        if size_of(counted.ranges[value]) > largest:
            outside = f"coalesce(abs({layers.column(value)[0]}) > {largest}, false)::INTEGER"
            clips.append(f"{times} * {outside}" if times > 1 else outside)
    hidden = []
    for number in sorted(layers.layers):
        layer = _SEPARATOR.join(layers.layers[number])
        rows = f"(SELECT *,\n            {layer}\n        FROM {rows})"
        hidden += [column.rpartition(" AS ")[2] for column in layers.layers[number]]
    exclude = f" EXCLUDE ({', '.join(hidden)})" if hidden else ""
    columns.append(f"{' + '.join(clips) or '0'} AS clipped")
    return f"(SELECT *{exclude},\n            {_SEPARATOR.join(columns)}\n        FROM {rows})"


def column_query(catalog: Catalog, name: str) -> str:
    """Return the query of `log_counts` for a feature or windowed column. Raises `QuestionError`."""
    definition = catalog.definition(name)
    if definition is not None and definition.number is not None:
        raise QuestionError(
            f"{name} is {catalog.calibrated[name].of} times {definition.number.name} of each car, "
            "in counts: see fleet-slip features --sql of the one, and the view calibration."
        )
    if definition is not None and name not in catalog.features:
        rows = with_columns("log_counts", {}, {name: definition})
    elif name in catalog.features:
        rows = with_columns("log_counts", catalog.rows([name]), {})
    else:
        raise QuestionError(
            f"no feature, window or factor is called {name!r}. See: fleet-slip features"
        )
    return f"SELECT drive_id, tick, {name}\nFROM {rows}\nORDER BY drive_id, tick"
