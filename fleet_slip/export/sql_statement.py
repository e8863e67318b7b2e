"""A program as one SELECT over rows in SI units, in SQL of DuckDB, SQLite and PostgreSQL.

Values that are used more than once are columns of a layer of their own.
"""

from fleet_slip.catalog.signals import COUNT_MAX
from fleet_slip.columns.column_sql import PLAIN_SQL, SqlLayers, attribute_sql
from fleet_slip.export.program import Program
from fleet_slip.export.templating import fill_in_version
from fleet_slip.models.registry import ModelVersion

ROWS = "log"
"""Table or view of the plain statement: `drive_id`, `tick`, and columns in SI units."""


def sql_statement(
    version: ModelVersion, program: Program, rows: str = ROWS, macro: str = ""
) -> str:
    """Return the statement with the columns `drive_id`, `tick`, `angle` in counts and in SI units.

    `angle` is null if there is none. Rows are the ticks of drives, in any order.
    """
    layers = [*_input_layers(program), *_layers(program)]
    words = {"layers": layers, "rounded": _rounded(program), "rows": rows, "macro": macro}
    return fill_in_version("templates/statement.sql", version, program, **words)


def sql_macro(version: ModelVersion, program: Program) -> str:
    """Return the statement as a macro of DuckDB with the name of a table as argument."""
    name = f"{program.angle.name}_{version.manifest.name}"
    return sql_statement(version, program, "query_table(source)", name)


def _input_layers(program: Program) -> list[list[str]]:
    """Return layers that round inputs to counts, signals half to even; null is out of range."""
    counts, rounded, valid = [], [], []
    for place, signal in enumerate(program.signals):
        ratio = f"ratio_{place}"
        counts.append(f"{signal.column} / {signal.scale:f} AS {ratio}")
        half = f"CASE WHEN ABS({ratio} - ROUND({ratio})) = 0.5 THEN 2 * ROUND({ratio} / 2)"
        rounded.append(f"{half} ELSE ROUND({ratio}) END AS rounded_{place}")
        ends = (signal.min_count, signal.max_count)
        valid.append(f"{_within(f'rounded_{place}', *ends)} AS signal_{place}")
    for place, number in enumerate(program.numbers):
        counts.append(f"ROUND({number.name} / {number.grain:f}) AS ratio_number_{place}")
        valid.append(f"{_within(f'ratio_number_{place}', -COUNT_MAX, COUNT_MAX)} AS number_{place}")
    facts = [f"{attribute_sql(one)} AS fact_{place}" for place, one in enumerate(program.facts)]
    return [[*counts, *facts], rounded, valid]


def _within(value: str, low: int, high: int) -> str:
    return f"CASE WHEN {value} BETWEEN {low} AND {high} THEN CAST({value} AS BIGINT) END"


def _layers(program: Program) -> list[list[str]]:
    """Return the columns of each layer; the last layer has the parts of the angle."""
    sql = SqlLayers(program.steps, program.ranges, PLAIN_SQL, lambda name, place: f"{name}_{place}")
    terms = [sql.text(step) for step, _ in program.angle.terms]
    last = max(layer for _, layer in terms)
    sql.layers[last + 1] += _parts(program, [text for text, _ in terms])
    return [sql.layers[number] for number in sorted(sql.layers)]


def _parts(program: Program, terms: list[str]) -> list[str]:
    """Return the sums of the upper and of the lower parts; see `fixed_point`."""
    (high, low), *parts = program.angle.parts
    return [
        f"{first} + "
        + " + ".join(f"({part[i]}) * {t}" for part, t in zip(parts, terms, strict=True))
        + f" AS {name}"
        for i, (name, first) in enumerate((("high", high), ("low", low)))
    ]


def _rounded(program: Program) -> str:
    angle = program.angle
    shift = angle.bits - angle.low_bits
    carried = f"(high + {_floor('low', angle.low_bits)} + {2 ** (shift - 1)})"
    return PLAIN_SQL["clip"].format(_floor(carried, shift), angle.limit)


def _floor(value: str, bits: int) -> str:
    """Return SQL of a value over 2^bits, rounded down, by its non-negative remainder."""
    size = 2**bits
    remainder = f"(({value} % {size} + {size}) % {size})"
    return f"CAST(ROUND(({value} - {remainder}) / {size}) AS BIGINT)"
