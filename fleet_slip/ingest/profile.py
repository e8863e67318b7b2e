"""Profiles an unfamiliar file: rate, range, and share of missing values of each channel."""

import csv
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import parse_numbers
from fleet_slip.ingest.formats.csv import decompressed, first_lines
from fleet_slip.ingest.formats.file_formats import CanBus, CsvFormat, Encoding, FileFormats
from fleet_slip.ingest.formats.reading import (
    file_errors,
    require_unchanged_log,
)
from fleet_slip.ingest.formats.source import OWN_TIME, Channel, Source
from fleet_slip.ingest.formats.vbo import VBO_BEGINS
from fleet_slip.ingest.log_files import FileGroup, open_log
from fleet_slip.ingest.vocabulary import unit_called, vocabulary

# Guesses the layout of a text file: encoding, separator, and the lines of header, units and data.

_SEPARATORS = (";", "\t", "|", ",", " ")
_LINES = 120
_NUMBER = re.compile(
    r"\s*[-+]?(\d+([.,]\d*)?|[.,]\d+|\d{1,3}(\.\d{3})+(,\d*)?)([eE][-+]?\d+)?\s*|[-+]?nan",
    re.IGNORECASE,
)
_DECIMAL_COMMA = re.compile(r"\s*[-+]?[\d.]*,\d+([eE][-+]?\d+)?\s*")
_BOMS = (b"\xff\xfe", b"\xfe\xff")


def guess_layout(file: Path) -> tuple[CsvFormat, dict[str, str]]:
    """Return the layout of a text file, and the units of its columns if a line has them."""
    encoding = _guess_encoding(file)
    with file.open("rb") as stream:
        is_vbo = VBO_BEGINS.match(stream.read(2**10))
    if encoding is None or is_vbo:
        return CsvFormat(), {}
    lines = first_lines(file, CsvFormat(encoding=encoding), _LINES)
    if not lines:
        return CsvFormat(encoding=encoding), {}
    separator = max(_SEPARATORS, key=lambda candidate: _regularity(lines, candidate))
    rows = [_split(line, separator) for line in lines]
    header, data = _header_and_data(rows)
    fields = [field for row in rows[data:] for field in row]
    layout = CsvFormat(
        separator=separator,
        decimal_comma=separator != "," and any(_DECIMAL_COMMA.fullmatch(f) for f in fields),
        encoding=encoding,
        header_line=header + 1,
        data_line=data + 1 if data > header + 1 else None,
    )
    return layout, _units(rows[header], rows[header + 1 : data])


def _guess_encoding(file: Path) -> Encoding | None:
    """Return the encoding of a text file, None for a binary file."""
    with file.open("rb") as stream:
        start = decompressed(stream).read(2**16)
    if start.startswith(_BOMS):
        return "utf-16"
    if b"\0" in start:
        return None
    try:
        start[: start.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _split(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]


def _regularity(lines: list[str], separator: str) -> tuple[float, bool, float, int]:
    """Return how well a separator splits lines, as a tuple to compare.

    The share of the last lines with numbers in the usual number of fields, True if a header has as
    many fields, the share of lines with as many fields, and the number of fields.
    """
    rows = [_split(line, separator) for line in lines if line.strip()]
    last = rows[len(rows) // 2 :]
    width, often = Counter(map(len, last)).most_common(1)[0] if last else (1, 0)
    if width == 1:
        return 0.0, False, 0.0, 0
    numbers = sum(len(row) == width and _is_data(row) for row in last)
    has_header = any(len(row) == width and not _is_data(row) for row in rows)
    return round(numbers / len(last), 1), has_header, round(often / len(last), 1), width


def _header_and_data(rows: list[list[str]]) -> tuple[int, int]:
    """Return the places of the header and of the first line of data; 0 and 1 if they are not clear.

    Above the data are lines of as many fields, the first of which is the header; a blank line or a
    title in brackets may be between.
    """
    width = Counter(map(len, rows[len(rows) // 2 :])).most_common(1)[0][0]
    data = next((i for i, row in enumerate(rows) if len(row) == width and _is_data(row)), None)
    if not data:
        return 0, 1
    header, count = data, 0
    for place in range(data - 1, -1, -1):
        row = rows[place]
        if len(row) == width and sum(bool(field.strip()) for field in row) > width / 2:
            header, count = place, count + 1
        elif "".join(row).strip() and not re.fullmatch(r"\s*\[.*\]\s*", "".join(row)):
            break
        if count == 3:
            break
    return (header, data) if count else (0, 1)


def _is_data(row: list[str]) -> bool:
    filled = [field for field in row if field.strip()]
    numbers = sum(_NUMBER.fullmatch(field) is not None for field in filled)
    return bool(filled) and numbers >= max(len(filled) / 2, 1)


def _units(header: list[str], between: list[list[str]]) -> dict[str, str]:
    """Return the units of columns, from a line of as many fields in which one is a unit."""
    for row in between:
        if len(row) == len(header) and any(unit_called(field) for field in row):
            pairs = zip(header, row, strict=True)
            return {name.strip(): unit.strip(" []()") for name, unit in pairs}
    return {}


# Detection of markers for missing values: -9999, 65535, n.v.

_FAR = 2.0
"""Minimum distance of a marker from other values, as a multiple of their range."""
_MIN_VALUES = 20


def find_absent(profiles: Sequence["Profile"]) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return the markers for missing values in channels.

    Returns all as texts, for `missing` of a mapping, and the numbers among them. A number that is a
    plausible value in any channel is not a marker.
    """
    markers = vocabulary()["missing"]
    texts = [
        text for profile in profiles for text in profile.texts if text.lower() in markers["texts"]
    ]
    means_none: dict[float, bool] = {}
    for profile in profiles:
        present = profile.values[np.isfinite(profile.values)]
        is_known = np.isin(present, markers["numbers"])
        values = present[~is_known]
        for number in map(float, np.unique(present[is_known])):
            is_none = values.size >= _MIN_VALUES
            if is_none:
                low, high = float(values.min()), float(values.max())
                margin = _FAR * max(high - low, 1e-6)
                is_none = number > high + margin or number < low - margin
            means_none[number] = is_none and means_none.get(number, True)
    numbers = tuple(number for number, is_none in means_none.items() if is_none)
    written = [f"{number:.0f}" for number in numbers]
    return tuple(dict.fromkeys([*written, *texts])), numbers


PROFILE_ROWS = 200_000
"""Number of rows of each time base that are examined."""
_SAMPLE_TEXTS = 200
"""Number of texts that decide the format of times in a column."""


@dataclass(frozen=True)
class Profile:
    """One channel of a file.

    Attributes
    ----------
    rate_hz
        Sample rate of its time base, if the file has a clock.
    values
        The examined values as numbers, NaN for a missing value; times are seconds since 1970 or
        midnight. Empty for other texts.
    texts
        Examples of its texts; in a column of numbers, the texts that are not numbers.
    keys
        A number for each distinct text or whole number; empty for other columns.
    time_format
        Format of texts that are times; empty for a type that is a time.
    """

    channel: Channel
    rate_hz: float | None
    values: FloatArray
    texts: tuple[str, ...] = field(default=())
    keys: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    time_format: str | None = None

    @property
    def is_number(self) -> bool:
        """True if it contains numbers."""
        return self.time_format is None and bool(np.isfinite(self.values).any())

    @property
    def missing(self) -> float:
        """Share of the rows without a number."""
        return float(1 - np.isfinite(self.values).mean()) if self.values.size else 1.0

    @property
    def range(self) -> tuple[float, float]:
        """The smallest and the largest number. There must be at least one."""
        return float(np.nanmin(self.values)), float(np.nanmax(self.values))


@dataclass(frozen=True)
class FileProfile:
    """All channels of a file, in its order, and whether it has clocks of its own."""

    has_clock: bool
    formats: FileFormats
    profiles: tuple[Profile, ...]
    missing: tuple[str, ...] = ()
    """Markers for missing values, for `missing` of a mapping."""
    refused: tuple[str, ...] = ()
    """Problems of channels that cannot be read."""


def profile_file(file: Path, bus: CanBus | None = None) -> FileProfile:
    """Profile the first `PROFILE_ROWS` rows of every channel. Raises `InputError`."""
    is_text = bus is None and not isinstance(file, FileGroup)
    with require_unchanged_log(file), file_errors(file), ExitStack() as opened:
        layout, units = guess_layout(file) if is_text else (CsvFormat(), {})
        formats = FileFormats(csv=layout, can=bus)
        source = opened.enter_context(open_log(file, formats))
        channels = source.channels()
        with suppress(InputError):  # some formats read the file once for all these columns
            source.bases([channel.name for channel in channels])
        bases: dict[str, list[Channel]] = defaultdict(list)
        for channel in channels:
            with_unit = replace(channel, unit=channel.unit or units.get(channel.name, ""))
            bases[channel.base].append(with_unit)
        refused = source.unreadable()
        profiles = tuple(
            p
            for channels in bases.values()
            for p in _profile_base(source, channels, formats.csv, refused)
        )
        missing, numbers = find_absent([p for p in profiles if p.is_number])
        without = (np.where(np.isin(p.values, numbers), np.nan, p.values) for p in profiles)
        cleaned = tuple(replace(p, values=v) for p, v in zip(profiles, without, strict=True))
        reasons = tuple(dict.fromkeys(refused))
        return FileProfile(source.has_clock, formats, cleaned, missing, reasons)


def _profile_base(
    source: Source, channels: list[Channel], csv: CsvFormat, refused: list[str]
) -> Iterator[Profile]:
    """Yield the profiles of one time base; notes the problems of unreadable channels."""
    try:
        table = _first_rows(source, channels)
    except InputError as error:
        for channel in channels if len(channels) > 1 else ():
            yield from _profile_base(source, [channel], csv, refused)
        if len(channels) == 1:
            refused.append(str(error))
        return
    rate_hz = sample_rate_hz(table[OWN_TIME].to_numpy()) if OWN_TIME in table.columns else None
    for channel in channels:
        if channel.name in table.columns:
            yield _profile(channel, rate_hz, table[channel.name], csv)


def _first_rows(source: Source, channels: list[Channel]) -> pl.DataFrame:
    frames, rows = [], 0
    for frame in source.batches([channel.name for channel in channels]):
        frames.append(frame)
        rows += frame.height
        if rows >= PROFILE_ROWS:
            break
    return pl.concat(frames).head(PROFILE_ROWS) if frames else pl.DataFrame()


def _profile(channel: Channel, rate_hz: float | None, column: pl.Series, csv: CsvFormat) -> Profile:
    if column.dtype.is_temporal():
        first = tuple(map(str, column.drop_nulls()[:3]))
        is_time = isinstance(column.dtype, pl.Datetime)
        seconds = _seconds(column) if is_time else np.zeros(0)
        return Profile(channel, rate_hz, seconds, first, time_format="" if is_time else None)
    if not column.dtype.is_numeric():
        texts = column.cast(pl.String).str.strip_chars()
        numbers = texts.to_frame().select(
            parse_numbers(pl.col(texts.name), decimal_comma=csv.decimal_comma)
        )[texts.name]
        if numbers.is_not_null().any():
            odd = texts.filter(numbers.is_null() & (texts != "")).unique()[:20].to_list()
            return Profile(
                channel, rate_hz, numbers.fill_null(np.nan).to_numpy(), tuple(odd), _keys(texts)
            )
        examples = tuple(texts.drop_nulls().unique(maintain_order=True)[:3])
        if written := _time_format(texts):
            return Profile(
                channel, rate_hz, _read_times(texts, written), examples, time_format=written
            )
        return Profile(channel, rate_hz, np.zeros(0), examples, _keys(texts))
    values = column.cast(pl.Float64).fill_null(np.nan)
    return Profile(channel, rate_hz, values.to_numpy(), keys=_keys(column))


def _keys(column: pl.Series) -> NDArray[np.int64]:
    """Return a number for each text or whole number, in sorted order; empty for other columns."""
    if column.dtype.is_float() and not (column == column.round()).fill_null(value=True).all():
        return np.zeros(0, dtype=np.int64)
    return column.rank("dense").fill_null(0).cast(pl.Int64).to_numpy()


def _time_format(texts: pl.Series) -> str | None:
    """Return the first format that all texts at the beginning have."""
    examples = texts.drop_nulls().head(_SAMPLE_TEXTS)
    formats: list[str] = vocabulary()["time"]["formats"] if examples.len() else []
    return next(
        (candidate for candidate in formats if np.isfinite(_read_times(examples, candidate)).all()),
        None,
    )


def _read_times(texts: pl.Series, written: str) -> FloatArray:
    """Return seconds since 1970, or midnight, NaN for other texts."""
    if "%d" not in written:
        clock = texts.str.to_time(written, strict=False).cast(pl.Int64)
        return np.asarray((clock.cast(pl.Float64) / 1e9).fill_null(np.nan).to_numpy())
    return _seconds(texts.str.to_datetime(written, time_unit="us", strict=False))


def _seconds(moments: pl.Series) -> FloatArray:
    return np.asarray((moments.dt.epoch("us") / 1e6).fill_null(np.nan).to_numpy())


def sample_rate_hz(time_s: FloatArray) -> float | None:
    """Return the inverse of the median step of time; None if time does not increase."""
    step = np.median(np.diff(time_s)) if time_s.size > 1 else 0.0
    return float(1 / step) if step > 0 else None
