"""Reads VBO files of Racelogic: sections of text, and in `[data]` rows of numbers between blanks.

https://en.racelogic.support/VBOX_Automotive/Knowledge_Base/VBO_File_Format. Times are of the day
in UTC and go on over midnight; the first line has the date.
"""

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import takewhile

import numpy as np
import polars as pl

from fleet_slip.arrays import FloatArray
from fleet_slip.ingest.formats.csv import (
    CUT,
    EXTRA_FIELDS,
    FEWER,
    MAX_LINE_BYTES,
    described,
    first_lines,
)
from fleet_slip.ingest.formats.file_formats import CsvFormat
from fleet_slip.ingest.formats.source import OWN_TIME, Budget, Channel, Source, find_column
from fleet_slip.ingest.vocabulary import unit_called

VBO_BEGINS = re.compile(rb"(\xef\xbb\xbf)?\s*(file created on|\[header\])", re.IGNORECASE)
_MAX_HEAD_LINES = 1000
"""Lines above the data."""
_BATCH_CHARACTERS = 2**22
"""Characters of rows that are split at once, and the rest of the last row."""
_CREATED = re.compile(r"(\d+/\d+/\d{4})(?:\D+(\d+):(\d+))?")
_TIME, _TIME_OF_DAY = "time", r"^(\d\d)([0-5]\d)([0-5]\d(?:\.\d+)?)$"
_DAY_S = 86_400
_STANDARD_CHANNELS = {
    "lat": ("latitude", "deg"), "long": ("longitude", "deg"), "velocity": ("gnss speed", "km/h"),
    "heading": ("course", "deg"), "height": ("height", "m"),
}  # fmt: skip
"""The meaning of columns by name, and their units unless the file states others."""
_AS_NUMBERS = {
    "lat": pl.col("lat").cast(pl.Float64, strict=False) / 60,
    "long": pl.col("long").cast(pl.Float64, strict=False) / -60,
    "sats": pl.col("sats").cast(pl.Float64, strict=False) % 64,
}
"""Degrees, positive to the east, of minutes, positive to the west. To the number of satellites 64
is added while the brake is pressed, and 128 by a correction."""


class VboSource(Source):
    """A VBO file: columns of text, and the times of its clock."""

    has_clock = True

    def __init__(self, budget: Budget) -> None:
        """Take a file and read its header. Raises `InputError`."""
        self._budget = budget
        self._lines = first_lines(budget.file, CsvFormat(), _MAX_HEAD_LINES)
        self._places = {line.strip().lower(): number for number, line in enumerate(self._lines, 1)}
        for section in ("[column names]", "[data]"):
            if section not in self._places:
                raise budget.error(
                    f"a VBO file without the section {section}. Is it complete? Copy it again."
                )
        names = "".join(self._section("[column names]")[:1])
        self._names = [channel.name for channel in described(names.split())]
        fields = len("".join(self._section("[data]")[:1]).split())
        if fields and fields != len(self._names):
            raise budget.error(
                f"{len(self._names)} names in [column names], and {fields} fields in the first row "
                "of [data], so that values may belong to other columns. Correct the names: they "
                "cannot contain blanks."
            )

    def _section(self, name: str) -> list[str]:
        """Return the lines of a section up to an empty one, none where there is no such section."""
        begin = self._places.get(name, len(self._lines))
        return [*takewhile(bool, map(str.strip, self._lines[begin:]))]

    def channels(self) -> list[Channel]:
        """Return the columns but the time, with the units behind titles and those of modules."""
        titles, of_modules = self._section("[header]"), self._section("[channel units]")
        units = {name: unit for name, (_, unit) in _STANDARD_CHANNELS.items()}
        if len(titles) == len(self._names):
            called = (unit_called(title.rpartition(" ")[2]) for title in titles)
            units |= {n: unit for n, unit in zip(self._names, called, strict=True) if unit}
        units |= zip(self._names[::-1], of_modules[::-1], strict=False)  # the last columns
        return [
            Channel(name, units.get(name, ""), title=_STANDARD_CHANNELS.get(name, ("",))[0])
            for name in self._names
            if name != _TIME
        ]

    def find(self, column: str) -> tuple[str, int]:
        """Return the position of a column. Raises `InputError`."""
        return "", find_column(self._budget.file, self._names, column)

    def read(self, _base: str, places: dict[str, int]) -> Iterator[pl.DataFrame]:
        """Yield the columns as CSV does, with their times. Raises `InputError`."""
        _, time = self.find(_TIME)
        start_s, last_s = None, np.nan
        with self._budget.file.open(encoding="utf-8", errors="replace", newline="\n") as text:
            for _ in range(self._places["[data]"]):
                text.readline(MAX_LINE_BYTES)
            while block := text.read(_BATCH_CHARACTERS):
                end = text.readline(MAX_LINE_BYTES)
                lines = f"{block}{end}".split("\n")
                if len(end) == MAX_LINE_BYTES or max(map(len, lines)) > MAX_LINE_BYTES:
                    raise self._budget.error(
                        f"a line is longer than {MAX_LINE_BYTES:,} characters. Copy it again."
                    )
                fields = pl.Series(lines).str.replace_all(",", ".", literal=True)
                fields = fields.str.extract_all(r"\S+").alias("fields")
                fields = fields.filter(fields.list.len() > 0)
                times_s = _seconds(fields.list.get(time, null_on_oob=True))
                is_finite = np.isfinite(times_s)
                if is_finite.any():
                    if start_s is None:
                        last_s = times_s[is_finite][0]
                        start_s = self._start_s(last_s)
                    unwrapped_s = np.unwrap([last_s, *times_s[is_finite]], period=_DAY_S)[1:]
                    times_s[is_finite], last_s = unwrapped_s + start_s, unwrapped_s[-1]
                columns = {n: fields.list.get(p, null_on_oob=True) for n, p in places.items()}
                columns[EXTRA_FIELDS] = self._faults(fields, is_cut=lines[-1] != "")
                columns[OWN_TIME] = pl.Series(times_s).fill_nan(None)
                as_numbers = [number for name, number in _AS_NUMBERS.items() if name in places]
                yield pl.DataFrame(columns).with_columns(as_numbers)

    def _faults(self, fields: pl.Series, *, is_cut: bool) -> pl.Series:
        """Return `FEWER`, `CUT` or the fields after the last column; null for right rows."""
        row, width = pl.col("fields"), len(self._names)
        is_last = pl.int_range(pl.len()) == pl.len() - 1
        fewer = pl.when(is_last & is_cut).then(pl.lit(CUT)).otherwise(pl.lit(FEWER))
        extra = row.list.slice(width).list.join(" ")
        size = row.list.len()
        fault = pl.when(size < width).then(fewer).when(size > width).then(extra)
        return fields.to_frame().select(fault.alias("fault"))["fault"]

    def _start_s(self, first_s: float) -> float:
        """Return the midnight in s since 1970 that makes the first time next to the file's date."""
        created = _CREATED.search(self._lines[0])
        if created is None:
            return 0.0  # then the mapping needs a day
        day, hour, minute = created.groups()
        try:
            midnight = datetime.strptime(day, "%d/%m/%Y").replace(tzinfo=UTC)
        except ValueError:
            return 0.0
        clock_s = first_s if hour is None else 3600 * int(hour) + 60 * int(minute)
        return midnight.timestamp() + _DAY_S * round((clock_s - first_s) / _DAY_S)


def _seconds(times: pl.Series) -> FloatArray:
    """Return times of the day in s from texts such as 091430.01, NaN for others."""
    parts = (times.str.extract(_TIME_OF_DAY, n).cast(pl.Float64) for n in (1, 2, 3))
    hours, minutes, seconds = parts
    return (3600 * hours + 60 * minutes + seconds).fill_null(np.nan).to_numpy(writable=True)
