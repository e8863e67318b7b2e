"""The SQL of columns of counts: features of a row, and columns over time.

This is what defines them. Subqueries wrap a table expression with counts, so that anyone can run
them over the view `log_counts`.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.definitions import WEIGHT, Definition, Gate, features_behind, limit_of
from fleet_slip.catalogue.features import FeatureCatalogue
from fleet_slip.catalogue.signals import COUNT_MAX, catalogue
from fleet_slip.columns.lowering import Lowering
from fleet_slip.columns.operations import operation_of, plain_of
from fleet_slip.columns.sql_operations import DUCKDB_SQL, sql_constant, sql_of
from fleet_slip.errors import QuestionError

_SEPARATOR = ",\n            "


def rounded_sql(value: str, ratio: Fraction, divisor: str = "1") -> str:
    """Return SQL of value * ratio / divisor, rounded to the nearest, halves away from zero."""
    product = f"{value}::BIGINT * {ratio.numerator}" if ratio.numerator != 1 else f"{value}::BIGINT"
    below = f"{ratio.denominator} * {divisor}" if divisor != "1" else f"{ratio.denominator}"
    if below == "1":
        return product
    return DUCKDB_SQL["nearest"].format(f"({product})", f"({below})")


def clipped_sql(name: str, limit: int = COUNT_MAX) -> str:
    """Return the SQL of an integer column clipped to the range of counts; null stays null."""
    kind = "SMALLINT" if limit == COUNT_MAX else "INTEGER"
    return f"{DUCKDB_SQL['clip'].format(name, limit)}::{kind}"


def feature_sql(sql: str) -> str:
    """Return what DuckDB computes for the declared SQL of a feature: the same, taken apart."""
    arithmetic = parse(sql)
    texts: list[str] = []
    for step in arithmetic.steps:
        if step.name or not step.function:
            texts.append(f"{step.name}::BIGINT" if step.name else sql_constant(step.value))
            continue
        operands = [texts[one] for one in step.operands]
        positive = int(arithmetic.is_positive(step.operands[-1]))
        texts.append(sql_of(step.function, operands, divides_by=positive, table=DUCKDB_SQL))
    if arithmetic.guard is None:
        return texts[-1]
    return f"CASE WHEN {texts[arithmetic.guard]} >= {arithmetic.at_least} THEN {texts[-1]} END"


def with_absent(rows: str, absent: Sequence[str]) -> str:
    """Return a table expression with stored columns that none of its files has, as nulls."""
    if not absent:
        return rows
    nulls = ", ".join(map(catalogue().null_sql, absent))
    return f"(SELECT *, {nulls} FROM {rows})"


def with_features(
    rows: str, definitions: Mapping[str, str], limits: Mapping[str, int] | None = None
) -> str:
    """Return a subquery: the rows with features as columns of counts, each clipped to its limit.

    `rows` is a table expression with counts; `definitions` gives the SQL of each feature; `limits`
    those that are not int16. The column `clipped` says how many of the features of a row were out
    of range.
    """
    computed = {name: feature_sql(sql) for name, sql in definitions.items()}
    return _layer(rows, computed, limits or {}) if definitions else rows


def with_windows(
    rows: str, features: Mapping[str, str], definitions: Mapping[str, Definition]
) -> str:
    """Return a subquery: the rows of a table expression with features and columns over time.

    `features` gives the SQL of features of 16 bits. The column `clipped` counts what was out of
    range, also of what is looked back on.
    """
    looked_at = features_behind(definitions)
    rows = with_features(
        rows,
        {**features, **{name: one.sql for name, one in looked_at.items()}},
        {name: limit_of(one.of_bits) for name, one in looked_at.items()},
    )
    if not definitions:
        return rows
    own = {name: one for name, one in definitions.items() if name not in looked_at}
    if not features and not looked_at:
        rows = f"(SELECT *, 0 AS clipped FROM {rows})"
    return over_windows(rows, own) if own else rows


def over_windows(rows: str, definitions: Mapping[str, Definition]) -> str:
    """Return the same where `rows` has what is looked back on already, and the column `clipped`.

    What is gated, and what opens gates, adds to it once, however many columns are made of it.
    """
    plain = {name: one for name, one in definitions.items() if not one.gate}
    gated = {name: one for name, one in definitions.items() if one.gate}
    found = _over_windows(rows, plain) if plain else rows
    return _gated(found, gated) if gated else found


def _gated(rows: str, definitions: Mapping[str, Definition]) -> str:
    """Return the rows with gated columns, by way of hidden ones: the parts, then the weights."""
    parts = dict.fromkeys(part for one in definitions.values() for part in one.parts)
    hidden = {part: f"hidden_{number}" for number, part in enumerate(parts)}
    gates = dict.fromkeys(one.gate for one in definitions.values() if one.gate)
    weights = {gate: f"weight_{number}" for number, gate in enumerate(gates)}
    found = _over_windows(rows, {name: part for part, name in hidden.items()})
    weighed = _SEPARATOR.join(
        f"{weight_sql(hidden[gate.by], gate)} AS {name}" for gate, name in weights.items()
    )
    columns = _SEPARATOR.join(
        rounded_sql(f"({hidden[one.ungated]}::BIGINT * {weights[one.gate]})", Fraction(1, WEIGHT))
        + f"::INTEGER AS {name}"
        for name, one in definitions.items()
        if one.gate
    )
    behind = ", ".join((*hidden.values(), *weights.values()))
    return f"""(
        SELECT * EXCLUDE ({behind}),
            {columns}
        FROM (
            SELECT *,
            {weighed}
            FROM {found}
        )
    )"""


def weight_sql(by: str, gate: Gate) -> str:
    """Return the SQL of a gate's weight, given the name of the column that opens and closes it."""
    lowered = Lowering({})
    texts = {lowered.do("signal", 0): f"{by}::BIGINT"}
    weight = lowered.weight(0, gate)
    for number, step in enumerate(lowered.steps):
        name, plain = operation_of(step), plain_of(step)
        if name == "constant":
            texts[number] = sql_constant(plain[0])
        elif number not in texts:
            operands = [texts[one] for one in plain]
            texts[number] = sql_of(name, operands, divides_by=1, table=DUCKDB_SQL)
    return texts[weight]


def _over_windows(rows: str, definitions: Mapping[str, Definition]) -> str:
    """Return the rows with columns over time that have no gate."""
    frames = dict(frame_of(one) for one in definitions.values() if one.over)
    named = ",\n            ".join(
        f"{name} AS (PARTITION BY drive_id ORDER BY tick RANGE {frame})"
        for name, frame in frames.items()
    )
    limits = {name: limit_of(one.bits) for name, one in definitions.items()}
    clause = f"\n            WINDOW {named}" if frames else ""
    raw = {name: unclipped_sql(one) for name, one in definitions.items()}
    found = _layer(rows, raw, limits, clause=clause, counted=True)
    times = {
        name: rounded_sql(f"({name}::BIGINT * ({one.fact.sql}))", one.fact.ratio)
        for name, one in definitions.items()
        if one.fact
    }
    return _layer(found, times, limits, counted=True, replaced=True) if times else found


def frame_of(one: Definition) -> tuple[str, str]:
    """Return the name and the SQL of the frame of rows that a column looks back on."""
    if one.over == "lag":
        return f"lag_{one.ticks}", f"BETWEEN {one.ticks} PRECEDING AND {one.ticks} PRECEDING"
    if one.over == "running_mean":
        return "since_start", "BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW"
    return f"last_{one.ticks}", f"BETWEEN {one.ticks - 1} PRECEDING AND CURRENT ROW"


def unclipped_sql(one: Definition) -> str:
    """Return the count before it is clipped, as SQL over the frames and the columns of rows."""
    frame, _ = frame_of(one)
    if one.over is None:
        return rounded_sql(one.of, one.ratio)
    if one.over == "lag":
        return rounded_sql(f"(max({one.of}) OVER {frame})", one.ratio)
    total = f"(sum({one.of}::BIGINT) OVER {frame})::BIGINT"
    values = f"(count({one.of}) OVER {frame})" if one.over != "sum" else "1"
    quotient = rounded_sql(total, one.ratio, values)
    return f"CASE WHEN {one.of} IS NOT NULL THEN {quotient} END"


def _layer(
    rows: str,
    definitions: Mapping[str, str],
    limits: Mapping[str, int],
    *,
    clause: str = "",
    counted: bool = False,
    replaced: bool = False,
) -> str:
    """Return a subquery that computes columns, new ones or `replaced` ones, and clips them.

    With `counted`, the rows have the column `clipped` already.
    """
    limit = {name: limits.get(name, COUNT_MAX) for name in definitions}
    computed = _SEPARATOR.join(f"{sql} AS {name}" for name, sql in definitions.items())
    inside = [f"{clipped_sql(name, limit[name])} AS {name}" for name in definitions]
    outside = " + ".join(
        f"coalesce(abs({name}) > {limit[name]}, false)::INTEGER" for name in definitions
    )
    if counted:
        inside.append(f"clipped + {outside} AS clipped")
    new = "" if counted else f",\n            {outside} AS clipped"
    columns = (
        f"* REPLACE (\n            {computed}\n            )"
        if replaced
        else f"*,\n            {computed}"
    )
    return f"""(
        SELECT * REPLACE (
            {_SEPARATOR.join(inside)}
        ){new}
        FROM (
            SELECT {columns}
            FROM {rows}{clause}
        )
    )"""


def column_query(known: FeatureCatalogue, name: str) -> str:
    """Return the query over the view `log_counts` that computes a feature or column over time.

    Raises `QuestionError` for what is neither.
    """
    definition = known.definition(name)
    if definition is not None and definition.number is not None:
        raise QuestionError(
            f"{name} is {known.calibrated[name].of} times {definition.number.name} of each car, in "
            "counts: see fleet-slip features --sql of the one, and the view calibration."
        )
    if definition is not None:
        rows = with_windows("log_counts", {}, {name: definition})
    elif name in known.features:
        rows = with_features("log_counts", {name: known.features[name].sql})
    else:
        raise QuestionError(
            f"no feature, window or factor is called {name!r}. See: fleet-slip features"
        )
    return f"SELECT drive_id, tick, {name}\nFROM {rows}\nORDER BY drive_id, tick"
