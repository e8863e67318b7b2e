"""What is in a file from a stranger: each channel's rate, range, and share of missing values."""

import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.csv_batches import CsvFormat
from fleet_slip.ingest.formats.reading import (
    FileFormats,
    file_errors,
    open_source,
    require_unchanged_file,
)
from fleet_slip.ingest.formats.source import OWN_TIME, Channel, Source

MOST_ROWS = 200_000
"""Rows of each time base that are looked at."""
_SEPARATORS = ";\t|,"
_DECIMAL_COMMA = r"^\s*-?\d+,\d+\s*$"


@dataclass(frozen=True)
class Profile:
    """One channel of a file.

    Attributes:
        rate_hz: of its time base, where the file has a clock.
        values: those looked at as numbers, NaN where there is none; empty for texts.
        texts: some of its texts.
    """

    channel: Channel
    rate_hz: float | None
    values: FloatArray
    texts: tuple[str, ...] = field(default=())

    @property
    def is_number(self) -> bool:
        """Whether there are numbers in it."""
        return bool(np.isfinite(self.values).any())

    @property
    def missing(self) -> float:
        """Part of the rows without a number."""
        return float(1 - np.isfinite(self.values).mean()) if self.values.size else 1.0

    @property
    def range(self) -> tuple[float, float]:
        """The least and the largest number. There must be one."""
        return float(np.nanmin(self.values)), float(np.nanmax(self.values))


@dataclass(frozen=True)
class FileProfile:
    """All channels of a file, in its order, and whether it has clocks of its own."""

    has_clock: bool
    formats: FileFormats
    profiles: tuple[Profile, ...]


def profile_file(file: Path, formats: FileFormats) -> FileProfile:
    """Look at the first `MOST_ROWS` rows of every channel. Raises `InputError`."""
    with require_unchanged_file(file), file_errors(file), ExitStack() as opened:
        if formats.can is None and formats.duckdb is None:
            formats = FileFormats(csv=_guess_csv(file))
        source = opened.enter_context(open_source(file, formats))
        bases: dict[str, list[Channel]] = defaultdict(list)
        for channel in source.channels():
            bases[channel.base].append(channel)
        found = tuple(p for of in bases.values() for p in _profile_base(source, of, formats.csv))
        return FileProfile(source.has_clock, formats, found)


def _profile_base(source: Source, channels: list[Channel], csv: CsvFormat) -> Iterator[Profile]:
    """Yield what can be read of one time base; a channel that cannot is passed over."""
    try:
        table = _first_rows(source, channels)
    except InputError:
        if len(channels) > 1:
            for channel in channels:
                yield from _profile_base(source, [channel], csv)
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
        if rows >= MOST_ROWS:
            break
    return pl.concat(frames).head(MOST_ROWS) if frames else pl.DataFrame()


def _profile(channel: Channel, rate_hz: float | None, column: pl.Series, csv: CsvFormat) -> Profile:
    if column.dtype.is_temporal():
        return Profile(channel, rate_hz, np.zeros(0), tuple(map(str, column.drop_nulls()[:3])))
    if not column.dtype.is_numeric():
        texts = column.cast(pl.String).str.strip_chars()
        plain = texts.str.replace(",", ".", literal=True) if csv.decimal_comma else texts
        numbers = plain.cast(pl.Float64, strict=False)
        if numbers.is_not_null().any():
            return Profile(channel, rate_hz, numbers.fill_null(np.nan).to_numpy())
        return Profile(channel, rate_hz, np.zeros(0), tuple(texts.drop_nulls().unique()[:3]))
    return Profile(channel, rate_hz, column.cast(pl.Float64).fill_null(np.nan).to_numpy())


def sample_rate_hz(time_s: FloatArray) -> float | None:
    """Return one over the usual step of time, None if time does not go on."""
    step = np.median(np.diff(time_s)) if time_s.size > 1 else 0.0
    return float(1 / step) if step > 0 else None


def _guess_csv(file: Path) -> CsvFormat:
    """Return how a text file is written: the separator that is most in its first line."""
    with file.open("rb") as stream:
        lines = stream.read(2**16).decode("utf-8", "replace").splitlines()
    if not lines:
        return CsvFormat()
    separator = max(_SEPARATORS, key=lines[0].count)
    if separator == "," or not lines[0].count(separator):
        return CsvFormat()
    fields = [field for line in lines[1:50] for field in line.split(separator)]
    return CsvFormat(
        separator=separator, decimal_comma=any(re.match(_DECIMAL_COMMA, f) for f in fields)
    )
