"""Fills in `jobs/gram.sql` for a feature set: its columns, and what divides a drive's rows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from fleet_slip.catalogue.column_sql import over_windows, with_absent, with_features
from fleet_slip.catalogue.feature_sets import LAG, PLAIN, Regime
from fleet_slip.catalogue.features import FeatureCatalogue, features
from fleet_slip.catalogue.signals import COUNT_MAX, SignalCatalogue
from fleet_slip.resources import read_sql

LOGS = "read_parquet(getvariable('log_files'), union_by_name => true, hive_partitioning => false)"

_SEPARATOR = ",\n            "

BITS = 63
"""Bits of a BIGINT that are no sign."""

UNKNOWN_PART = "unknown"
"""Part of the rows whose regime is not known because a signal is absent."""


@dataclass(frozen=True)
class Parts:
    """What divides a drive's rows: the SQL of a part's number, 0 ..., and the parts' names."""

    number: str
    names: tuple[str, ...]


def gram_statement(
    signals: SignalCatalogue,
    feature_set: str = PLAIN,
    *,
    whole: bool = False,
    absent: Sequence[str] = (),
) -> str:
    """Return the statement that computes the Gram rows of a feature set.

    `whole` states that no file has a column of the set in only some of its rows; `absent` are the
    signals that no file has, since they came to the catalogue later. Raises
    `QuestionError` for an unknown set.
    """
    known = features()
    one = known.feature_set(feature_set)
    names = one.columns
    regimes = [known.regimes[name] for name in one.regimes]
    windows = known.definitions(feature_set)
    looked_at = [*(regime.of for regime in regimes), *(window.of for window in windows.values())]
    used = {
        name: known.features[name]
        for name in dict.fromkeys([*one.features, *looked_at])
        if name in known.features
    }
    definitions = {name: feature.sql for name, feature in used.items()}
    logs = with_absent(LOGS, absent)
    if one.lagged:
        rows = _lagged(names, logs)
    else:
        rows = with_features(logs, definitions, {n: feature.limit for n, feature in used.items()})
    if windows:
        rows = over_windows(rows if used else f"(SELECT *, 0 AS clipped FROM {logs})", windows)
    wide = windows or any(feature.limit > COUNT_MAX for feature in used.values())
    kind = "BIGINT" if wide else "INTEGER"
    parts = _row_folds(one.row_folds) if one.row_folds else _regime_parts(regimes, known)
    return read_sql("jobs", "gram.sql").format(
        drive_columns=", ".join(signals.drive),
        qualified_drive_columns=", ".join(f"drive.{name}" for name in signals.drive),
        absent="0" if whole else _absent(names),
        part=parts.number if parts else "NULL",
        clipped="sum(clipped)::BIGINT" if definitions or windows else "0",
        sums=_SEPARATOR.join(f"sum({name})" for name in names),
        products=_SEPARATOR.join(
            f"sum({a}::{kind} * {b}::{kind})" for i, a in enumerate(names) for b in names[: i + 1]
        ),
        counts=rows,
        group=", ".join(_group(whole=whole, divided=parts is not None)),
        part_name=_part_name(parts) if parts else "NULL::VARCHAR",
        names=", ".join(f"'{name}'" for name in names),
    )


def _group(*, whole: bool, divided: bool) -> list[str]:
    """Return the columns to group by. DuckDB hashes a dictionary's entries, not its rows, if the
    dictionary's column is the only one; so a constant is left out."""
    return ["drive_id", *([] if whole else ["absent"]), *(["part"] if divided else [])]


def _absent(names: Sequence[str]) -> str:
    """Return SQL of a number with a bit for each column that a row lacks; of many, a list."""
    if len(names) < BITS:
        kind = "INTEGER" if len(names) < 32 else "BIGINT"
        return " + ".join(f"({name} IS NULL)::{kind} * {1 << i}" for i, name in enumerate(names))
    parts = [_absent(names[first : first + BITS - 1]) for first in range(0, len(names), BITS - 1)]
    # The last columns come first, so that lists sort as the one large number would.
    return f"[{', '.join(f'({part})::BIGINT' for part in reversed(parts))}]"


def _part_name(parts: Parts) -> str:
    names = ", ".join(f"'{name}'" for name in parts.names)
    return f"coalesce([{names}][gram.part + 1], '{UNKNOWN_PART}')"


def _regime_parts(regimes: Sequence[Regime], known: FeatureCatalogue) -> Parts | None:
    """Number the combinations of bands, the last regime running fastest."""
    if not regimes:
        return None
    number = "0"
    names = [""]
    for regime in regimes:
        number = f"({number}) * {len(regime.bands)} + {_band(regime, known)}"
        names = [f"{name}, {band}".removeprefix(", ") for name in names for band in regime.bands]
    return Parts(number, tuple(names))


def _band(regime: Regime, known: FeatureCatalogue) -> str:
    """Return the SQL of a row's band: how many of the bounds it has reached."""
    value = f"abs({regime.of}::INTEGER)" if regime.absolute else regime.of
    scale = known.of(regime.of).exact_scale
    # Counts are whole, so that reaching a bound is reaching the next whole count.
    counts = [math.ceil(Fraction(bound) / scale) for bound in regime.bounds]
    return "(" + " + ".join(f"({value} >= {count})::INTEGER" for count in counts) + ")"


def _row_folds(count: int) -> Parts:
    """Number the folds by a hash of drive and tick that is the same everywhere and for ever.

    MD5 of the drive's id begins a sequence; two rounds of multiplication and exclusive or (the
    32-bit integer hash of Thomas Mueller) scatter the ticks. All below 2^63.
    """
    value = "((md5_number_lower(drive_id) % 4294967296)::BIGINT + tick) % 4294967296"
    for _ in range(2):
        value = f"xor({value}, ({value}) >> 16) * 73244475 % 4294967296"
    return Parts(f"({value}) % {count}", tuple(str(fold + 1) for fold in range(count)))


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
