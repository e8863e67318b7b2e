"""What looks wrong in a log as a whole: many refused rows, times that are assumed, several cars.

Rows are of several cars that a mapping takes for those of one where neighbouring rows differ by
more than a car can change, a car is under way twice, or a column named like cars is not mapped.
"""

import itertools
import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from collections.abc import Mapping as Named
from pathlib import Path

import numpy as np
import polars as pl

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.faults import Fault
from fleet_slip.ingest.drives import DriveRows, MeasuredDrive
from fleet_slip.ingest.formats.reading import file_errors, open_source
from fleet_slip.ingest.mapping import FromColumn, Mapping
from fleet_slip.ingest.suspicion import RADIUS_M, WHEELS
from fleet_slip.ingest.vocabulary import is_called, vocabulary

# What looks wrong in a file as a whole: many rows refused, and times that are assumed.

LARGEST_REFUSED, FEWEST_REFUSED = 0.1, 10
_REFUSED = {
    "out_of_range": ("scaled", "Check its unit."),
    "not_a_number": ("texts", "Name those that mean no value under missing."),
    "not_finite": ("values", 'Write missing = ["nan"] if they mean no value.'),
}
_OF_TIME = ("time", "isolated", "too_short", "not_a_time")
_LIMITS = {
    **dict.fromkeys(WHEELS, (3 / RADIUS_M, 150 / RADIUS_M)),  # a wheel may lock within 0.15 s
    "vx": (3.0, 30.0),
    "vehicle_speed": (3.0, 30.0),
    "steering_wheel": (0.5, 30.0),
    "yaw_rate": (0.3, 30.0),
}
"""More than its own noise, and so much a second, no car's signal changes from row to row."""
_STANDING = {**dict.fromkeys(WHEELS, 2 / RADIUS_M), "vx": 2.0, "vehicle_speed": 2.0}
"""A speed below, as any 0, is that of a car that stands, or of a sensor lost for a while."""
FEWEST_JUMPS, FEWEST_A_MINUTE = 10, 3.0
MOST_SINGLE = 0.15
"""Where more neighbours than this part jump, these are no single values that went wrong."""
LONGEST_HELD_S = 0.1
"""A bus repeats a value until its next message: what stays for longer does not change so fast."""
OVERLAP_S = 1.0
MOST_NAMES, LEAST_ROWS_A_NAME = 1000, 20


class LogFaults:
    """What looks wrong in one log, whose drives are added one by one."""

    def __init__(self, file: Path, mapping: Mapping) -> None:
        """Begin without drives."""
        self._file, self._mapping = file, mapping
        self._drives = 0
        self._jumps: Counter[str] = Counter()
        self._under_way: dict[str, list[tuple[float, float]]] = defaultdict(list)

    def add(self, rows: DriveRows, drive: MeasuredDrive) -> None:
        """Look at the rows of a drive."""
        self._drives += 1
        for name in _LIMITS:
            samples = rows.samples(name)
            values = (samples[column].to_numpy() for column in ("time", name))
            self._jumps[name] += _count_jumps(name, *values)
        if drive.metadata["started_at"] is not None:
            car = str(drive.metadata["vehicle_id"])
            self._under_way[car].append((rows.start_s, rows.end_s))

    def find(
        self, refused: Named[tuple[str, str], int], rows: int, reasons: Named[str, int]
    ) -> Iterator[Fault]:
        """Yield what looks wrong, once all drives were looked at; see `find_refusals`."""
        yield from find_refusals(refused, rows, reasons)
        remedy = "Set vehicle_id or drive.column."
        for name, jumps in self._jumps.most_common(1):
            if jumps:
                figure = (
                    f"it jumps implausibly between rows ({jumps:,} times), as if cars were mixed"
                )
                yield Fault("cars", (name,), figure, remedy)
        twice = sum(_overlaps(under_way) for under_way in self._under_way.values())
        if twice:
            figure = f"drives of one car overlap in time ({twice:,} times)"
            yield Fault("repeated", ("time",), figure, remedy)
        yield from _unmapped_cars(self._file, self._mapping, self._drives)
        if self._mapping.time.assumed:
            figure = f"the log has no time column; {self._mapping.time.rate_hz:g} Hz is assumed"
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


def _count_jumps(name: str, time_s: FloatArray, values: FloatArray) -> int:
    """Return how often a signal jumps from row to row, 0 if so seldom that a sensor may do it."""
    if time_s.size < FEWEST_JUMPS or not time_s[-1] > time_s[0]:
        return 0
    if np.count_nonzero(np.abs(np.diff(values)) > _LIMITS[name][0]) < FEWEST_JUMPS:
        return 0  # for most drives this is enough, at a third of the cost of all below
    jumps = _jumps(name, time_s, values)
    if jumps.sum() < max(FEWEST_JUMPS, MOST_SINGLE * jumps.size):  # values that are wrong alone
        alone = np.zeros(values.size, dtype=np.bool_)
        alone[1:-1] = jumps[:-1] & jumps[1:]
        jumps = _jumps(name, time_s[~alone], values[~alone])
    minutes = (time_s[-1] - time_s[0]) / 60
    return int(jumps.sum()) if jumps.sum() >= max(FEWEST_JUMPS, FEWEST_A_MINUTE * minutes) else 0


def _jumps(name: str, time_s: FloatArray, values: FloatArray) -> BoolArray:
    noise, rate = _LIMITS[name]
    slower = np.minimum(np.abs(values[1:]), np.abs(values[:-1]))
    step_s, changes = np.diff(time_s), np.diff(values) != 0
    since = np.maximum.accumulate(np.where(np.r_[True, changes[:-1]], time_s[:-1], -np.inf))
    held_s = np.where(time_s[1:] - since <= LONGEST_HELD_S, time_s[1:] - since, step_s)
    jumps = np.abs(np.diff(values)) > noise + rate * held_s
    return np.asarray(jumps & (slower > _STANDING.get(name, 0.0)))


def _overlaps(under_way: list[tuple[float, float]]) -> int:
    """Return how many of some drives begin while an earlier one is under way."""
    ordered = sorted(under_way)
    latest = itertools.accumulate((end for _, end in ordered), max)
    return sum(
        start < end - OVERLAP_S for (start, _), end in zip(ordered[1:], latest, strict=False)
    )
