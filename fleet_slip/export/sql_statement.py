"""A program as one SELECT over rows in SI units, in plain SQL that several engines take as it is.

DuckDB, SQLite and PostgreSQL do. What is used more than once is a column of a layer of its own.
"""

from fleet_slip.catalog.signals import COUNT_MAX
from fleet_slip.columns.column_sql import PLAIN_SQL, SqlLayers, attribute_sql
from fleet_slip.export.program import Program
from fleet_slip.export.templating import fill_in_version
from fleet_slip.models.registry import ModelVersion

ROWS = "log"
"""The table or view that the plain statement reads: `drive_id`, `tick`, and columns in SI units."""


def sql_statement(
    version: ModelVersion, program: Program, rows: str = ROWS, macro: str = ""
) -> str:
    """Return the statement, which gives `drive_id`, `tick`, `angle` in counts, and it in SI units.

    `angle` is null where there is none. Rows are the ticks of drives, in any order.
    """
    layers = [*_given(program), *_layers(program)]
    words = {"layers": layers, "rounded": _rounded(program), "rows": rows, "macro": macro}
    return fill_in_version("templates/statement.sql", version, program, **words)


def sql_macro(version: ModelVersion, program: Program) -> str:
    """Return the statement as a macro of DuckDB, which takes the name of a table."""
    name = f"{program.angle.name}_{version.manifest.name}"
    return sql_statement(version, program, "query_table(source)", name)


def _given(program: Program) -> list[list[str]]:
    """Return layers that round what is given to counts, signals half to even; beyond is null."""
    counts, rounded, valid = [], [], []
    for place, one in enumerate(program.signals):
        ratio = f"ratio_{place}"
        counts.append(f"{one.column} / {one.scale:f} AS {ratio}")
        half = f"CASE WHEN ABS({ratio} - ROUND({ratio})) = 0.5 THEN 2 * ROUND({ratio} / 2)"
        rounded.append(f"{half} ELSE ROUND({ratio}) END AS rounded_{place}")
        ends = (one.min_count, one.max_count)
        valid.append(f"{_within(f'rounded_{place}', *ends)} AS signal_{place}")
    for place, number in enumerate(program.numbers):
        counts.append(f"ROUND({number.name} / {number.grain:f}) AS told_{place}")
        valid.append(f"{_within(f'told_{place}', -COUNT_MAX, COUNT_MAX)} AS number_{place}")
    facts = [f"{attribute_sql(one)} AS fact_{place}" for place, one in enumerate(program.facts)]
    return [[*counts, *facts], rounded, valid]


def _within(value: str, least: int, most: int) -> str:
    return f"CASE WHEN {value} BETWEEN {least} AND {most} THEN CAST({value} AS BIGINT) END"


def _layers(program: Program) -> list[list[str]]:
    """Return the columns of each layer; the last has the parts of the angle."""
    found = SqlLayers(
        program.steps, program.ranges, PLAIN_SQL, lambda name, place: f"{name}_{place}"
    )
    terms = [found.text(step) for step, _ in program.angle.terms]
    last = max(layer for _, layer in terms)
    found.layers[last + 1] += _parts(program, [text for text, _ in terms])
    return [found.layers[number] for number in sorted(found.layers)]


def _parts(program: Program, terms: list[str]) -> list[str]:
    """Return the sums of the upper and of the lower parts; see `fixed_point`."""
    (high, low), *parts = program.angle.parts
    return [
        f"{first} + "
        + " + ".join(f"({part[which]}) * {t}" for part, t in zip(parts, terms, strict=True))
        + f" AS {name}"
        for name, first, which in (("high", high, 0), ("low", low, 1))
    ]


def _rounded(program: Program) -> str:
    angle = program.angle
    shift = angle.bits - angle.low_bits
    carried = f"(high + {_floor('low', angle.low_bits)} + {2 ** (shift - 1)})"
    return PLAIN_SQL["clip"].format(_floor(carried, shift), angle.limit)


def _floor(value: str, bits: int) -> str:
    """Return SQL of a value over 2^bits, rounded down: its remainder is brought above zero."""
    size = 2**bits
    remainder = f"(({value} % {size} + {size}) % {size})"
    return f"CAST(ROUND(({value} - {remainder}) / {size}) AS BIGINT)"
