"""Fills in `jobs/gram.sql` for a feature set: its columns, and what divides a drive's rows."""

from collections.abc import Sequence

from fleet_slip.catalogue.course_change import COURSE_LATE, with_changes
from fleet_slip.catalogue.definitions import COUNT_BITS
from fleet_slip.catalogue.feature_sets import LAG, PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import SignalCatalogue
from fleet_slip.columns.column_sql import with_absent, with_columns
from fleet_slip.grams.rows.drive_parts import Parts
from fleet_slip.resources import read_sql

LOGS = "read_parquet(getvariable('log_files'), union_by_name => true, hive_partitioning => false)"

_SEPARATOR = ",\n            "

BITS = 63
"""Bits of a BIGINT that are no sign."""

MOST_SUMS = 8_000
"""Sums of one grouping: DuckDB 2.0.0 ends with SIGFPE where those of a group, 24 bytes each, are
longer than its block of 262,144 bytes."""


def gram_statement(
    signals: SignalCatalogue,
    feature_set: str = PLAIN,
    *,
    whole: bool = False,
    absent: Sequence[str] = (),
) -> str:
    """Return the statement that computes the Gram rows of a feature set.

    `whole`: no file has a column in only some rows; `absent` are later columns, which none has.
    Raises `QuestionError` for an unknown set.
    """
    known = features()
    one = known.feature_set(feature_set)
    names = one.columns
    windows = known.definitions(feature_set)
    regimes = [known.regimes[name].of for name in one.regimes]
    used = known.rows(dict.fromkeys([*one.features, *regimes]))
    logs = with_absent(LOGS, absent)
    rows = _lagged(names, logs) if one.lagged else with_columns(logs, used, windows)
    if one.change_ticks:
        columns = (*one.signals, *one.features, *one.windows)
        rows = with_changes(rows, columns, one.change_ticks, in_time=one.in_time)
    wide = windows or any(feature.bits > COUNT_BITS for feature in used.values())
    kind = "BIGINT" if wide else "INTEGER"
    parts = Parts.of_set(known, one)
    absent_sql, part = "0" if whole else _absent(names), parts.number_sql if parts else "NULL"
    sums = [f"sum({name})" for name in names]
    products = [
        f"sum({a}::{kind} * {b}::{kind})" for i, a in enumerate(names) for b in names[: i + 1]
    ]
    first = MOST_SUMS - len(sums)
    further = [products[i : i + MOST_SUMS] for i in range(first, len(products), MOST_SUMS)]
    group = ", ".join(_group(whole=whole, divided=bool(parts)))
    counted = ""
    if further:
        clipped = ", clipped" if used or windows else ""
        kept = f"{absent_sql} AS absent, {part} AS part{clipped}, {', '.join(names)}"
        counted = f"counted AS MATERIALIZED (\n    SELECT drive_id, {kept}\n    FROM {rows}\n),\n\n"
        rows, absent_sql, part, group = "counted", "absent", "part", "drive_id, absent, part"
    return read_sql("jobs", "gram.sql").format(
        drive_columns=", ".join(
            signals.null_sql(name) if name in absent else name for name in signals.drive
        ),
        qualified_drive_columns=", ".join(f"drive.{name}" for name in signals.drive),
        absent=absent_sql,
        part=part,
        counted=counted,
        clipped="sum(clipped)::BIGINT" if used or windows else "0",
        sums=_SEPARATOR.join(sums),
        products=_SEPARATOR.join(products[:first]),
        counts=rows,
        group=group,
        further="".join(_further(i, some) for i, some in enumerate(further)),
        joined="".join(_joined(i) for i in range(len(further))),
        all_products=" || ".join(
            ["gram.products", *(f"further_{i}.products" for i in range(len(further)))]
        ),
        course_late=_course_late(one.in_time),
        part_name=parts.name_sql("gram.part") if parts else "NULL::VARCHAR",
        names=", ".join(f"'{name}'" for name in names),
    )


def _course_late(in_time: bool) -> str:
    """Return what a Gram row records of the delay that was corrected in it."""
    known = f"getvariable('{COURSE_LATE}')[drive.vehicle_id]"
    return f",\n    {known}::BIGINT AS {COURSE_LATE}" if in_time else ""


def _further(number: int, products: Sequence[str]) -> str:
    """Return further products of the groups, which have their keys to be joined by."""
    return (
        f",\n\nfurther_{number} AS (\n    SELECT\n        drive_id,\n        absent,\n"
        f"        part,\n        [\n            {_SEPARATOR.join(products)}\n"
        "        ]::BIGINT[] AS products\n    FROM counted\n    GROUP BY drive_id, absent, part\n)"
    )


def _joined(number: int) -> str:
    other = f"further_{number}"
    return (
        f"\nJOIN {other} ON {other}.drive_id = gram.drive_id AND {other}.absent = gram.absent "
        f"AND {other}.part IS NOT DISTINCT FROM gram.part"
    )


def _group(*, whole: bool, divided: bool) -> list[str]:
    """Return the columns to group by, no constant, lest DuckDB hash a dictionary row by row."""
    return ["drive_id", *([] if whole else ["absent"]), *(["part"] if divided else [])]


def _absent(names: Sequence[str]) -> str:
    """Return SQL of a number with a bit for each column that a row lacks; of many, a list."""
    if len(names) < BITS:
        kind = "INTEGER" if len(names) < 32 else "BIGINT"
        return " + ".join(f"({name} IS NULL)::{kind} * {1 << i}" for i, name in enumerate(names))
    parts = [_absent(names[first : first + BITS - 1]) for first in range(0, len(names), BITS - 1)]
    # The last columns come first, so that lists sort as the one large number would.
    return f"[{', '.join(f'({part})::BIGINT' for part in reversed(parts))}]"


def _lagged(names: Sequence[str], logs: str) -> str:
    """Return the rows that have a predecessor in their drive, with both rows' counts."""
    now = [name for name in names if not name.endswith(LAG)]
    lags = _SEPARATOR.join(f"lag({name}) OVER before AS {name}{LAG}" for name in now)
    return (
        f"(\n        SELECT\n            drive_id,\n            {', '.join(now)},\n"
        f"            {lags}\n        FROM {logs}\n"
        "        WINDOW before AS (PARTITION BY drive_id ORDER BY tick)\n"
        "        QUALIFY lag(tick) OVER before = tick - 1\n    )"
    )
