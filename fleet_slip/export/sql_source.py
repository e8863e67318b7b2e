"""A program as one SELECT over rows in SI units: windows, and integers of 64 bits.

It is plain SQL, which DuckDB, SQLite and PostgreSQL take as it is. Where `/` of whole numbers is a
division in floating point, it is exact too: what is divided is a multiple of the divisor, and the
quotient far below 2^53.
"""

from collections.abc import Iterable

from fleet_slip.catalogue.columns import LARGEST_FACT, WEIGHT
from fleet_slip.catalogue.signals import COUNT_MAX
from fleet_slip.export.c_columns import sum_key, summed
from fleet_slip.export.program import CarFact, Factor, Gated, Numbered, Program, Source, Window
from fleet_slip.models.model_version import ModelVersion

ROWS = "log"
"""The table or view that the plain statement reads: `drive_id`, `tick`, and columns in SI units."""


def sql_statement(version: ModelVersion, program: Program, rows: str = ROWS) -> str:
    """Return the statement, which gives `drive_id`, `tick`, `angle` in counts, and it in SI units.

    `angle` is null where there is none. Rows are the ticks of drives, in any order.
    """
    angle = program.angle
    layers = [
        ("given", ["drive_id", "tick", *_given(program)]),
        ("signals", _valid(program)),
        ("sources", _sources(program)),
        ("sources_clipped", _clipped("source_raw", "source", enumerate(_limits(program)))),
        ("sums", _sums(program)),
        ("quotients", _quotients(program)),
        ("windows", _clipped("raw", "column", _of_windows(program))),
        ("products", _products(program)),
        ("factors", _clipped("raw", "column", _of_factors(program))),
        ("weights", _weights(program)),
        ("gated", _gated(program)),
        ("numbered", _numbered(program)),
        ("parts", _parts(program)),
    ]
    text, before = [], rows
    for name, columns in layers:
        if columns:
            kept = [] if name == "given" else ["*"]
            listed = ",\n        ".join([*kept, *columns])
            text.append(f"{name} AS (\n    SELECT\n        {listed}\n    FROM {before}\n)")
            before = name
    layered = ",\n\n".join(text)
    return (
        f"{_comment(version, program)}\nWITH {layered},\n\n"
        f"rounded AS (\n    SELECT drive_id, tick, {_rounded(program)} AS angle\n"
        f"    FROM {before}\n)\n\n"
        f"SELECT\n    drive_id,\n    tick,\n    angle,\n"
        f"    CAST(angle AS DOUBLE PRECISION) * {angle.scale:f} AS {angle.column}\nFROM rounded\n"
    )


def sql_macro(version: ModelVersion, program: Program) -> str:
    """Return the statement as a macro of DuckDB, which takes the name of a table."""
    name = f"{program.angle.name}_{version.manifest.name}"
    statement = sql_statement(version, program, "query_table(source)")
    comment, body = statement.split("\nWITH ", 1)
    return f"{comment}\nCREATE OR REPLACE MACRO {name}(source) AS TABLE\nWITH {body.rstrip()};\n"


def _comment(version: ModelVersion, program: Program) -> str:
    angle, trained = program.angle, version.manifest.trained_on
    return (
        f"-- {version.reference}: {angle.column}, exported by fleet-slip. Do not edit.\n"
        f"-- SHA-256 of the version: {version.sha256}\n"
        f"-- Trained on {trained.drives} drives, SHA-256 {trained.drives_sha256 or 'unknown'}\n"
        f"-- angle: counts of {angle.scale:f} {angle.unit}, "
        f"within {float(angle.error):.12f} counts of the exact model"
    )


def _given(program: Program) -> list[str]:
    """Return the counts of signals, and what the car knows, as whole numbers."""
    signals = [
        f"CAST(ROUND({one.column} / {one.scale:f}) AS BIGINT) AS {one.name}_in"
        for one in program.signals
    ]
    facts = [f"{_fact(one)} AS fact_{place}" for place, one in enumerate(program.facts)]
    numbers = [
        f"CAST(ROUND({one.name} / {one.grain:f}) AS BIGINT) AS number_{place}"
        for place, one in enumerate(program.numbers)
    ]
    return [*signals, *facts, *numbers]


def _fact(one: CarFact) -> str:
    if one.equals is None:
        known = f"ABS({one.name}) <= {LARGEST_FACT}"
        return f"CASE WHEN {known} THEN CAST(ROUND({one.name}) AS BIGINT) END"
    is_it = f"{one.name} = '{one.equals}'"
    return f"CASE WHEN {is_it} THEN 1 WHEN {one.name} IS NOT NULL THEN 0 END"


def _valid(program: Program) -> list[str]:
    return [
        f"CASE WHEN {one.name}_in BETWEEN {one.min_count} AND {one.max_count} "
        f"THEN {one.name}_in END AS {one.name}_valid"
        for one in program.signals
    ]


def _limits(program: Program) -> list[int]:
    return [one.limit for one in program.sources]


def _sources(program: Program) -> list[str]:
    return [f"{_source(one)} AS source_raw_{place}" for place, one in enumerate(program.sources)]


def _source(one: Source) -> str:
    if one.arithmetic is None:
        return f"{one.name}_valid"
    texts: list[str] = []
    conditions = []
    for number, step in enumerate(one.arithmetic.steps):
        operands = [texts[i] for i in step.operands]
        if step.name or not step.function:
            texts.append(f"{step.name}_valid" if step.name else f"{step.value}")
        else:
            texts.append(_operation(step.function, operands))
        if step.function == "//" and not operands[1].isdigit():
            conditions.append(f"{operands[1]} > 0")
        if number == one.arithmetic.guard:
            conditions.insert(0, f"{texts[-1]} >= {one.arithmetic.at_least}")
    if not conditions:
        return texts[-1]
    return f"CASE WHEN {' AND '.join(conditions)} THEN {texts[-1]} END"


def _operation(function: str, operands: list[str]) -> str:
    a, b = operands[0], operands[-1]
    match function:
        case "negative":
            return f"(-{a})"
        case "abs":
            return f"ABS({a})"
        case "sign":
            return f"(CASE WHEN {a} > 0 THEN 1 WHEN {a} < 0 THEN -1 ELSE 0 * {a} END)"
        case "//":
            return divide(a, b)
        case _:
            return f"({a} {function} {b})"


def divide(a: str, b: str) -> str:
    """Return SQL of a / b, truncated; b is positive."""
    return f"CAST(ROUND(({a} - {a} % {b}) / {b}) AS BIGINT)"


def nearest(a: str, b: str) -> str:
    """Return SQL of a / b to the nearest, halves away from zero; b is positive."""
    size = divide(f"(2 * ABS({a}) + {b})", f"(2 * {b})")
    return f"(CASE WHEN {a} < 0 THEN -{size} ELSE {size} END)"


def _clipped(raw: str, name: str, limits: Iterable[tuple[int, int]]) -> list[str]:
    return [
        f"CASE WHEN {raw}_{place} > {limit} THEN {limit} "
        f"WHEN {raw}_{place} < -{limit} THEN -{limit} ELSE {raw}_{place} END AS {name}_{place}"
        for place, limit in limits
    ]


def _sums(program: Program) -> list[str]:
    """Return sums and numbers of values of windows, and values of before."""
    found = []
    for key, (_, one) in summed(program).items():
        back = f"{one.ticks - 1} PRECEDING" if one.ticks else "UNBOUNDED PRECEDING"
        over = _over(f"RANGE BETWEEN {back} AND CURRENT ROW")
        source = f"source_{one.source}"
        found += [
            f"CAST(SUM({source}) {over} AS BIGINT) AS sum_{key}",
            f"COUNT({source}) {over} AS values_{key}",
        ]
    for place, column in enumerate(program.columns):
        if isinstance(column, Window) and column.over == "lag":
            over = _over(f"RANGE BETWEEN {column.ticks} PRECEDING AND {column.ticks} PRECEDING")
            found.append(f"MAX(source_{column.source}) {over} AS past_{place}")
    return found


def _over(frame: str) -> str:
    return f"OVER (PARTITION BY drive_id ORDER BY tick {frame})"


def _quotients(program: Program) -> list[str]:
    found = []
    for place, one in enumerate(program.columns):
        if not isinstance(one, Window):
            continue
        now = f"past_{place}" if one.over == "lag" else f"source_{one.source}"
        total, divisor = now, f"{one.denominator}"
        if one.over in ("mean", "sum", "running_mean"):
            total = f"sum_{sum_key(place, one)}"
        if one.over in ("mean", "running_mean"):
            divisor = f"({divisor} * values_{sum_key(place, one)})"
        quotient = nearest(f"({total} * {one.numerator})", divisor)
        found.append(f"CASE WHEN {now} IS NOT NULL THEN {quotient} END AS raw_{place}")
    return found


def _of_windows(program: Program) -> list[tuple[int, int]]:
    return [(i, one.limit) for i, one in enumerate(program.columns) if isinstance(one, Window)]


def _of_factors(program: Program) -> list[tuple[int, int]]:
    return [(i, one.limit) for i, one in enumerate(program.columns) if isinstance(one, Factor)]


def _products(program: Program) -> list[str]:
    found = []
    for place, one in enumerate(program.columns):
        if isinstance(one, Factor):
            product = f"(column_{one.of} * (fact_{one.fact} - ({one.less})) * {one.numerator})"
            found.append(f"{nearest(product, str(one.denominator))} AS raw_{place}")
    return found


def _weights(program: Program) -> list[str]:
    found = []
    for place, one in enumerate(program.columns):
        if isinstance(one, Gated):
            at = f"column_{one.by}"
            rising = divide(f"(({at} - ({one.low})) * {WEIGHT})", str(one.peak - one.low))
            cases = f"WHEN {at} <= {one.low} THEN 0 WHEN {at} < {one.peak} THEN {rising}"
            if one.high is None:
                cases += f" WHEN {at} IS NOT NULL THEN {WEIGHT}"
            else:
                falls = divide(f"(({at} - ({one.peak})) * {WEIGHT})", str(one.high - one.peak))
                cases += f" WHEN {at} < {one.high} THEN {WEIGHT} - {falls}"
                cases += f" WHEN {at} IS NOT NULL THEN 0"
            found.append(f"CASE {cases} END AS weight_{place}")
    return found


def _gated(program: Program) -> list[str]:
    return [
        f"{nearest(f'(column_{one.of} * weight_{place})', str(WEIGHT))} AS column_{place}"
        for place, one in enumerate(program.columns)
        if isinstance(one, Gated)
    ]


def _numbered(program: Program) -> list[str]:
    found = []
    for place, one in enumerate(program.columns):
        if isinstance(one, Numbered):
            number = f"number_{one.number}"
            stand_in = "0" if one.running is None else f"column_{one.running}"
            known = (
                f"(CASE WHEN {number} > {COUNT_MAX} THEN {COUNT_MAX} WHEN {number} < -{COUNT_MAX} "
            )
            known += f"THEN -{COUNT_MAX} ELSE {number} END - ({one.less}))"
            factor = f"(CASE WHEN {number} IS NULL THEN {stand_in} ELSE {known} END)"
            value = factor if one.alone else f"column_{one.of} * {factor}"
            found.append(
                f"CASE WHEN column_{one.of} IS NOT NULL THEN {value} END AS column_{place}"
            )
    return found


def _parts(program: Program) -> list[str]:
    """Return the sums of the upper and of the lower parts; see `fixed_point`."""
    (high, low), *parts = program.angle.parts
    sums = []
    for name, first, which in (("high", high, 0), ("low", low, 1)):
        terms = " + ".join(
            f"({part[which]}) * column_{place}"
            for part, (place, _) in zip(parts, program.angle.terms, strict=True)
        )
        sums.append(f"{first} + {terms} AS {name}")
    return sums


def _rounded(program: Program) -> str:
    angle = program.angle
    shift = angle.bits - angle.low_bits
    carried = f"(high + {_floor('low', angle.low_bits)} + {2 ** (shift - 1)})"
    found = _floor(carried, shift)
    return (
        f"CASE WHEN {found} > {angle.limit} THEN {angle.limit} "
        f"WHEN {found} < -{angle.limit} THEN -{angle.limit} ELSE {found} END"
    )


def _floor(value: str, bits: int) -> str:
    """Return SQL of a value over 2^bits, rounded down: its remainder is brought above zero."""
    size = 2**bits
    remainder = f"(({value} % {size} + {size}) % {size})"
    return f"CAST(ROUND(({value} - {remainder}) / {size}) AS BIGINT)"
