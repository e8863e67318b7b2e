"""Reads VBO files of Racelogic: sections of text, and in `[data]` rows of numbers between blanks.

https://en.racelogic.support/VBOX_Automotive/Knowledge_Base/VBO_File_Format. Times are of the day
in UTC and go on over midnight; the first line has the date.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any, BinaryIO

import numpy as np
import polars as pl

from fleet_slip.arrays import FloatArray
from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.csv import EXTRA_FIELDS, FEWER, CsvSource, described, first_lines
from fleet_slip.ingest.formats.file_formats import CsvFormat, PlainNumbers
from fleet_slip.ingest.formats.source import OWN_TIME, Budget, Channel
from fleet_slip.ingest.vocabulary import unit_called

VBO_BEGINS = re.compile(rb"(\xef\xbb\xbf)?\s*(file created on|\[header\])", re.IGNORECASE)
_MAX_HEAD_LINES = 1000
"""Lines above the data."""
_CREATED = re.compile(r"(\d+/\d+/\d{4})(?:\D+(\d+):(\d+))?")
_TIME, _TIME_OF_DAY = "time", r"^(\d\d)([0-5]\d)([0-5]\d(?:[.,]\d+)?)$"
_DAY_S = 86_400
_STANDARD_CHANNELS = {
    "lat": ("latitude", "deg"), "long": ("longitude", "deg"), "velocity": ("gnss speed", "km/h"),
    "heading": ("course", "deg"), "height": ("height", "m"),
}  # fmt: skip
"""The meaning of columns by name, and their units unless the file states others."""
_DEGREES = {"lat": 1 / 60, "long": -1 / 60}
"""Degrees, positive to the east, of minutes, positive to the west."""
_LAST = "\0last"
"""The last column, which a row with fewer fields does not have."""
_BLANKS, _AROUND = re.compile(rb"[ \t]{2,}|\t"), re.compile(rb"(?m)^[ \t]+|[ \t]+(\r?)$")
_FLAGS = 64
"""To the number of satellites 64 is added while the brake is pressed, and 128 by a correction."""


class VboSource(CsvSource):
    """A VBO file: columns of text or plain numbers, as of CSV, and the times of its clock."""

    has_clock = True

    def __init__(self, budget: Budget, numbers: PlainNumbers) -> None:
        """Take a file and read its header. Raises `InputError`."""
        lines = first_lines(budget.file, CsvFormat(), _MAX_HEAD_LINES)
        self._places = {line.strip().lower(): number for number, line in enumerate(lines, 1)}
        for section in ("[column names]", "[data]"):
            if section not in self._places:
                raise InputError(
                    f"{quote_name(budget.file)}: a VBO file without the section {section}. Is it "
                    "complete? Copy it again."
                )
        names, data = self._places["[column names]"] + 1, self._places["[data]"] + 1
        comma = "," in "".join(lines[data - 1 : data])
        layout = CsvFormat(
            separator=" ", decimal_comma=comma, header_line=names, data_line=max(data, names + 1)
        )
        super().__init__(budget, layout, replace(numbers, columns=numbers.columns - {_TIME}))
        self._lines, self._created = lines, _CREATED.search(lines[0])
        called, first = lines[names - 1].split(), " ".join(lines[data - 1 : data]).split()
        if first and len(first) != len(called):
            raise InputError(
                f"{quote_name(budget.file)}: {len(called)} names in [column names], and "
                f"{len(first)} fields in the first row of [data], so that values may belong to "
                "other columns. Correct the names: they cannot contain blanks."
            )

    def _read_header(self, stream: BinaryIO) -> list[Channel]:
        """Return the columns, whose names are between blanks, and pass over all before the data."""
        super()._read_header(stream)
        return described(self._lines[self.csv_format.header_line - 1].split())

    def _cleaned(self, lines: bytes) -> bytes:
        """Return lines with one blank between fields, and none around them."""
        single = _BLANKS.sub(b" ", lines) if _BLANKS.search(lines) else lines
        return _AROUND.sub(rb"\1", single)

    def _section(self, name: str) -> list[str]:
        """Return the lines of a section up to an empty one, none where there is no such section."""
        begin = self._places.get(name, len(self._lines))
        return [*takewhile(bool, map(str.strip, self._lines[begin:]))]

    def channels(self) -> list[Channel]:
        """Return the columns but the time, with the units behind titles and those of modules."""
        titles, of_modules = self._section("[header]"), self._section("[channel units]")
        names = [channel.name for channel in self._header]
        units = {name: unit for name, (_, unit) in _STANDARD_CHANNELS.items()}
        if len(titles) == len(self._header):
            called = (unit_called(title.rpartition(" ")[2]) for title in titles)
            units |= {n: unit for n, unit in zip(names, called, strict=True) if unit}
        units |= zip(names[::-1], of_modules[::-1], strict=False)  # the last columns
        return [
            Channel(
                channel.name,
                units.get(channel.name, ""),
                title=_STANDARD_CHANNELS.get(channel.name, ("",))[0],
            )
            for channel in super().channels()
            if channel.name not in {"", _TIME}
        ]

    def read(self, base: str, places: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield the columns as CSV does, with their times. Raises `InputError`."""
        _, place = self.find(_TIME)
        start_s, last_s = None, np.nan
        last = {_LAST: len(self._header) - 1}
        for parsed in super().read(base, places | {_TIME: place} | last):
            fewer = pl.when(pl.col(_LAST).is_null()).then(pl.lit(FEWER))
            fault = pl.coalesce(EXTRA_FIELDS, fewer).alias(EXTRA_FIELDS)
            rows = parsed.with_columns(fault).drop(_LAST)
            times_s = _seconds(rows[_TIME])
            is_finite = np.isfinite(times_s)
            if is_finite.any():
                if start_s is None:
                    last_s = times_s[is_finite][0]
                    start_s = self._start_s(last_s)
                unwrapped_s = np.unwrap(np.append(last_s, times_s[is_finite]), period=_DAY_S)[1:]
                times_s[is_finite], last_s = unwrapped_s + start_s, unwrapped_s[-1]
            yield rows.select(pl.exclude({_TIME} - places.keys())).with_columns(
                *(_number(name) * factor for name, factor in _DEGREES.items() if name in places),
                *(_number(name) % _FLAGS for name in places if name == "sats"),
                pl.Series(OWN_TIME, times_s).fill_nan(None),
            )

    def _start_s(self, first_s: float) -> float:
        """Return the midnight in s since 1970 that makes the first time next to the file's date."""
        if self._created is None:
            return 0.0  # then the mapping needs a day
        day, hour, minute = self._created.groups()
        try:
            midnight = datetime.strptime(day, "%d/%m/%Y").replace(tzinfo=UTC)
        except ValueError:
            return 0.0
        clock_s = first_s if hour is None else 3600 * int(hour) + 60 * int(minute)
        return midnight.timestamp() + _DAY_S * round((clock_s - first_s) / _DAY_S)


def _seconds(times: pl.Series) -> FloatArray:
    """Return times of the day in s from texts such as 091430.01, NaN for others."""
    plain = times.str.replace(",", ".", literal=True)
    parts = (plain.str.extract(_TIME_OF_DAY, n).cast(pl.Float64) for n in (1, 2, 3))
    hours, minutes, seconds = parts
    return (3600 * hours + 60 * minutes + seconds).fill_null(np.nan).to_numpy(writable=True)


def _number(name: str) -> pl.Expr:
    text = pl.col(name).cast(pl.String).str.replace(",", ".", literal=True)
    return text.cast(pl.Float64, strict=False)
