"""Brings the tables of a file with several time bases into one, in which every signal keeps its own
samples: a row is a sample time of one of them, and has no value of the others.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import count

import numpy as np
import polars as pl

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.source import BASE

DISORDER = "\0disorder"
"""Column that says what is wrong with a row's time among those of its base, null if nothing."""
HELD = "\0held "
"""Before the name of a column: its last value at the time, whatever base the row is of."""


def merge_bases(
    tables: Iterable[pl.DataFrame], time: str, held: Sequence[str], split_gap_s: float
) -> pl.DataFrame:
    """Return one table of all rows, in the order of the tables, with `BASE` as a number.

    Times are in s. Within a base they must increase: what does not has its reason in `DISORDER`,
    because once bases are mixed it could not be told. The `held` columns say of every row what was
    last known, for `split_gap_s` at most: conditions and names of drives hold for all signals.

    Raises `InputError` for a time that is no number.
    """
    parts: dict[str, list[pl.DataFrame]] = defaultdict(list)
    columns: dict[str, pl.DataType] = {}
    for table in tables:
        if not table[time].dtype.is_numeric():
            raise InputError(
                f"the time {time!r} is not of numbers; signals with times of their own need them."
            )
        parts[table[BASE][0] if len(table) else ""].append(table)
        columns |= dict(table.drop(BASE).schema)
    bases = [pl.concat(of_base).drop(BASE) for name, of_base in parts.items() if name]
    if not bases:
        return pl.DataFrame()
    # Of a base without rows there is nothing but its columns.
    there = {name for base in bases for name in base.columns}
    empty = [pl.lit(None, kind).alias(name) for name, kind in columns.items() if name not in there]
    bases[0] = bases[0].with_columns(empty)
    if len(bases) < 2:
        return bases[0]
    ordered = [
        base.with_columns(_disorder(base[time].to_numpy(), split_gap_s), pl.lit(i).alias(BASE))
        for i, base in zip(count(), bases)
    ]
    last = {name: _samples(ordered, name, time) for name in held}
    return pl.concat(
        [
            base.with_columns(
                _hold(*last[name], base[time].to_numpy(), split_gap_s).alias(HELD + name)
                for name in held
            )
            for base in ordered
        ],
        how="diagonal",
    )


def _disorder(time_s: FloatArray, split_gap_s: float) -> pl.Series:
    """Name what is wrong with each time of one base.

    A time far ahead of those around it is `isolated`, or it would make all that follow backwards.
    """
    ahead = np.zeros(time_s.size, dtype=np.bool_)
    if time_s.size > 2:
        step = np.diff(time_s)
        ahead[1:-1] = (step[:-1] > split_gap_s) & (time_s[2:] < time_s[1:-1])
    usable = np.where(ahead | ~np.isfinite(time_s), -np.inf, time_s)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(usable)[:-1]])
    reason = np.full(time_s.size, None, dtype=object)
    reason[time_s < before] = "time_backwards"
    reason[time_s == before] = "time_duplicate"
    reason[ahead] = "isolated"
    return pl.Series(DISORDER, reason.tolist(), pl.String)


def _samples(bases: Sequence[pl.DataFrame], name: str, time: str) -> tuple[FloatArray, pl.Series]:
    """Return times and values of the base that has a column, those in order and not null."""
    base = next(base for base in bases if name in base.columns)
    usable = base.filter(pl.col(name).is_not_null() & pl.col(DISORDER).is_null())
    usable = usable.filter(pl.col(time).is_finite())
    return usable[time].to_numpy(), usable[name]


def _hold(time_s: FloatArray, values: pl.Series, at_s: FloatArray, longest_s: float) -> pl.Series:
    """Return the last value at each time, null if it is older than `longest_s`."""
    if not time_s.size:
        return pl.Series([None] * at_s.size, dtype=values.dtype)
    last = np.searchsorted(time_s, at_s, side="right") - 1
    held = values.gather(np.maximum(last, 0))
    known = (last >= 0) & (at_s - time_s[np.maximum(last, 0)] <= longest_s)
    return held.set(pl.Series(~known), None)
