"""What looks wrong in a log as a whole: many refused rows, times that are assumed, several cars.

Rows are of several cars that a mapping takes for those of one where a car is under way twice, or a
column named like cars is not mapped.
"""

import itertools
import json
from collections import Counter
from collections.abc import Iterator
from collections.abc import Mapping as Named
from pathlib import Path

import polars as pl

from fleet_slip.catalogue.faults import Fault
from fleet_slip.ingest.formats.reading import file_errors, open_source
from fleet_slip.ingest.mapping import FromColumn, Mapping
from fleet_slip.ingest.vocabulary import is_called, vocabulary

# What looks wrong in a file as a whole: many rows refused, and times that are assumed.

LARGEST_REFUSED, FEWEST_REFUSED = 0.1, 10
_REFUSED = {
    "out_of_range": ("scaled", "Check its unit."),
    "not_a_number": ("texts", "Name those that mean no value under missing."),
    "not_finite": ("values", 'Write missing = ["nan"] if they mean no value.'),
}
_OF_TIME = ("time", "isolated", "too_short", "not_a_time")
OVERLAP_S = 1.0
MOST_NAMES, LEAST_ROWS_A_NAME = 1000, 20


def find_log_faults(
    file: Path, mapping: Mapping, drives: int, under_way: Named[str, list[tuple[float, float]]]
) -> Iterator[Fault]:
    """Yield what looks wrong in a log of so many drives, but for refused rows.

    `under_way` are the first and the last times of the drives of each car, where they are dated.
    """
    if twice := sum(map(_overlaps, under_way.values())):
        figure = f"drives of one car overlap in time ({twice:,} times)"
        yield Fault("repeated", ("time",), figure, "Set vehicle_id or drive.column.")
    yield from _unmapped_cars(file, mapping, drives)
    if mapping.time.assumed:
        figure = f"the log has no time column; {mapping.time.rate_hz:g} Hz is assumed"
        remedy = "Set the true rate_hz and remove assumed = true."
        yield Fault("time", ("rate_hz",), figure, remedy)


def find_refusals(
    refused: Named[tuple[str, str], int], rows: int, reasons: Named[str, int]
) -> Iterator[Fault]:
    """Yield each signal for which more than a tenth of a file's rows were refused, and all others.

    `refused` are rows by signal and reason, `reasons` all refused rows by reason.
    """
    most = max(rows * LARGEST_REFUSED, FEWEST_REFUSED)
    several = {key: count for key, count in refused.items() if count > most}
    for (name, reason), count in several.items():
        kind, remedy = _REFUSED.get(reason, ("values", "Look at the column."))
        figure = f"{count:,} of {rows:,} rows were refused: {reason}"
        yield Fault(kind, (name,), figure, remedy)
    others = Counter(reasons)
    for (_, reason), count in several.items():
        others[reason] -= count
    if others.total() <= most:
        return
    ((reason, count),) = others.most_common(1)
    figure = f"{others.total():,} of {rows:,} rows were refused, {count:,} of them: {reason}"
    if reason.startswith(_OF_TIME):
        remedy = "Check the column of times, its unit and its format"
        if reason in {"time_duplicate", "time_backwards"}:
            remedy += ", and set vehicle_id or drive.column if the file mixes cars or trips"
        yield Fault("values", ("time",), figure, f"{remedy}.")
    else:
        yield Fault("values", ("rows",), figure, "Look at the view quarantine.")


def _unmapped_cars(file: Path, mapping: Mapping, drives: int) -> Iterator[Fault]:
    """Yield columns named as cars or trips are of several values, and that a mapping passes by.

    `drives` is what the file fell into. Logs that have clocks of their own are those of one car.
    """
    wanted = {
        key: words
        for key, words in vocabulary()["cars"].items()
        if not (mapping.drive.column or isinstance(getattr(mapping.drive, key), FromColumn))
    }
    if mapping.time.own_clock or not wanted:
        return
    used = {name for names in mapping.time_bases().values() for name in names}
    with file_errors(file), open_source(file, mapping.formats) as source:
        names = [channel.name for channel in source.channels()]
        for key, words in wanted.items():
            for name in names:
                if name in used or names.count(name) > 1 or not is_called(words, name):
                    continue
                column = pl.concat([batch[name] for batch in source.batches([name])])
                values, runs = _values_and_runs(column)
                if values > 1 and (key == "vehicle_id" or runs > values or values > drives):
                    figure = f"it has {values:,} values, and the mapping does not use it"
                    where = f"column = {json.dumps(name, ensure_ascii=False)}"
                    where = f"{key} = {{ {where} }}" if key != "column" else where
                    yield Fault("cars", (name,), figure, f"Write {where} under [drive].")


def _values_and_runs(column: pl.Series) -> tuple[int, int]:
    """Return how many names a column has, and how often one begins; none if it is a quantity."""
    texts = column.cast(pl.String).str.strip_chars()
    present = texts.filter(texts.is_not_null() & (texts != ""))
    values = present.n_unique()
    if values > min(MOST_NAMES, len(present) // LEAST_ROWS_A_NAME):
        return 0, 0
    return values, 1 + int((present != present.shift()).sum())


def _overlaps(under_way: list[tuple[float, float]]) -> int:
    """Return how many of some drives begin while an earlier one is under way."""
    ordered = sorted(under_way)
    latest = itertools.accumulate((end for _, end in ordered), max)
    return sum(
        start < end - OVERLAP_S for (start, _), end in zip(ordered[1:], latest, strict=False)
    )
