"""The SQL of columns of counts, of a row and over time, as subqueries of `log_counts`."""

from collections.abc import Mapping, Sequence

from fleet_slip.catalogue.definitions import Definition
from fleet_slip.catalogue.feature_catalogue import FeatureCatalogue
from fleet_slip.catalogue.signals import COUNT_MAX, catalogue
from fleet_slip.columns.counted_columns import CountedColumns, rows_of
from fleet_slip.columns.operations import plain_of, size_of
from fleet_slip.columns.sql_operations import DUCKDB_SQL, SqlLayers, fact_sql
from fleet_slip.errors import QuestionError

_SEPARATOR = ",\n            "


def with_absent(rows: str, absent: Sequence[str]) -> str:
    """Return a table expression with stored columns that none of its files has, as nulls."""
    if not absent:
        return rows
    nulls = ", ".join(map(catalogue().null_sql, absent))
    return f"(SELECT *, {nulls} FROM {rows})"


def with_columns(
    rows: str, features: Mapping[str, Definition], over_time: Mapping[str, Definition]
) -> str:
    """Return a subquery: the rows of a table expression with features and columns over time.

    `clipped` counts what was out of range in a row. Raises `QuestionError` or `DataError` for a
    feature that is defined in two ways.
    """
    if not features and not over_time:
        return rows
    known = rows_of(features, over_time)
    counted = CountedColumns.of(known, over_time)
    signals, facts = list(counted.lowered.signals), list(counted.lowered.facts)
    layers = SqlLayers(
        counted.steps,
        counted.ranges,
        DUCKDB_SQL,
        lambda name, place: (
            f"{signals[place]}::BIGINT" if name == "signal" else f"({fact_sql(facts[place])})"
        ),
    )
    columns, clips = [], []
    for name, place in counted.places.items():
        if name not in signals:
            size = size_of(counted.ranges[place])
            kind = "SMALLINT" if size <= COUNT_MAX else "INTEGER"
            columns.append(f"{layers.column(place)[0]}::{kind} AS {name}")
    for place, times in counted.times.items():
        value, limit = plain_of(counted.steps[place])
        most = plain_of(counted.steps[limit])[0]
        if size_of(counted.ranges[value]) > most:
            outside = f"coalesce(abs({layers.column(value)[0]}) > {most}, false)::INTEGER"
            clips.append(f"{times} * {outside}" if times > 1 else outside)
    hidden = []
    for number in sorted(layers.layers):
        made = _SEPARATOR.join(layers.layers[number])
        rows = f"(SELECT *,\n            {made}\n        FROM {rows})"
        hidden += [one.rpartition(" AS ")[2] for one in layers.layers[number]]
    exclude = f" EXCLUDE ({', '.join(hidden)})" if hidden else ""
    columns.append(f"{' + '.join(clips) or '0'} AS clipped")
    return f"(SELECT *{exclude},\n            {_SEPARATOR.join(columns)}\n        FROM {rows})"


def column_query(known: FeatureCatalogue, name: str) -> str:
    """Return the query of `log_counts` for a feature or windowed column. Raises `QuestionError`."""
    definition = known.definition(name)
    if definition is not None and definition.number is not None:
        raise QuestionError(
            f"{name} is {known.calibrated[name].of} times {definition.number.name} of each car, in "
            "counts: see fleet-slip features --sql of the one, and the view calibration."
        )
    if definition is not None and name not in known.features:
        rows = with_columns("log_counts", {}, {name: definition})
    elif name in known.features:
        rows = with_columns("log_counts", known.rows([name]), {})
    else:
        raise QuestionError(
            f"no feature, window or factor is called {name!r}. See: fleet-slip features"
        )
    return f"SELECT drive_id, tick, {name}\nFROM {rows}\nORDER BY drive_id, tick"
