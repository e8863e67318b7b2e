"""What is in a file from a stranger: each channel's rate, range, and share of missing values."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.drafting.absent_values import Absent, find_absent, without_absent
from fleet_slip.ingest.drafting.text_layout import guess_layout
from fleet_slip.ingest.formats.csv_text import CsvFormat
from fleet_slip.ingest.formats.log_source import OWN_TIME, Channel, Source
from fleet_slip.ingest.formats.reading import (
    FileFormats,
    file_errors,
    open_source,
    require_unchanged_file,
)
from fleet_slip.ingest.mapping.vocabulary import vocabulary

MOST_ROWS = 200_000
"""Rows of each time base that are looked at."""
_LOOKED_AT = 200
"""Texts that tell whether a column has times, and of which format."""


@dataclass(frozen=True)
class Profile:
    """One channel of a file.

    Attributes:
        rate_hz: of its time base, where the file has a clock.
        values: those looked at as numbers, NaN where there is none; of times, seconds since 1970
            or midnight; empty for other texts.
        texts: some of its texts, all that are no numbers among numbers.
        keys: where it has texts or whole numbers, a number for each; else empty.
        time_format: of texts that are times; empty for a type that is a time.
    """

    channel: Channel
    rate_hz: float | None
    values: FloatArray
    texts: tuple[str, ...] = field(default=())
    keys: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    time_format: str | None = None

    @property
    def is_number(self) -> bool:
        """Whether there are numbers in it."""
        return self.time_format is None and bool(np.isfinite(self.values).any())

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
    absent: Absent = field(default_factory=Absent)
    """What means that there is no value."""


def profile_file(file: Path, formats: FileFormats) -> FileProfile:
    """Look at the first `MOST_ROWS` rows of every channel. Raises `InputError`."""
    with require_unchanged_file(file), file_errors(file), ExitStack() as opened:
        if formats.can is None and formats.duckdb is None:
            layout, units = guess_layout(file)
            formats = FileFormats(csv=layout)
        else:
            units = {}
        source = opened.enter_context(open_source(file, formats))
        bases: dict[str, list[Channel]] = defaultdict(list)
        for channel in source.channels():
            told = replace(channel, unit=channel.unit or units.get(channel.name, ""))
            bases[channel.base].append(told)
        found = tuple(p for of in bases.values() for p in _profile_base(source, of, formats.csv))
        absent = find_absent([(p.channel.name, p.values, p.texts) for p in found if p.is_number])
        cleaned = (replace(p, values=without_absent(p.values, absent)) for p in found)
        return FileProfile(source.has_clock, formats, tuple(cleaned), absent)


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
        first = tuple(map(str, column.drop_nulls()[:3]))
        is_time = isinstance(column.dtype, pl.Datetime)
        seconds = _seconds(column) if is_time else np.zeros(0)
        return Profile(channel, rate_hz, seconds, first, time_format="" if is_time else None)
    if not column.dtype.is_numeric():
        texts = column.cast(pl.String).str.strip_chars()
        plain = texts.str.replace(",", ".", literal=True) if csv.decimal_comma else texts
        numbers = plain.cast(pl.Float64, strict=False)
        if numbers.is_not_null().any():
            odd = texts.filter(numbers.is_null() & (texts != "")).unique()[:20].to_list()
            return Profile(
                channel, rate_hz, numbers.fill_null(np.nan).to_numpy(), tuple(odd), _keys(texts)
            )
        some = tuple(texts.drop_nulls().unique(maintain_order=True)[:3])
        for written in _time_formats(texts):
            return Profile(channel, rate_hz, _read_times(texts, written), some, time_format=written)
        return Profile(channel, rate_hz, np.zeros(0), some, _keys(texts))
    values = column.cast(pl.Float64).fill_null(np.nan)
    return Profile(channel, rate_hz, values.to_numpy(), keys=_keys(values))


def _keys(column: pl.Series) -> NDArray[np.int64]:
    """Return a number for each text or whole number, the first ones first; empty for others."""
    if column.dtype.is_float() and not (column == column.round()).all():
        return np.zeros(0, dtype=np.int64)
    return column.rank("dense").fill_null(0).cast(pl.Int64).to_numpy()


def _time_formats(texts: pl.Series) -> Iterator[str]:
    """Yield the first format that all texts at the beginning have."""
    some = texts.drop_nulls().head(_LOOKED_AT)
    for written in vocabulary()["time"]["formats"]:
        if some.len() and bool(np.isfinite(_read_times(some, written)).all()):
            yield written
            return


def _read_times(texts: pl.Series, written: str) -> FloatArray:
    """Return seconds since 1970, or midnight, NaN for what is no such time."""
    if "%d" not in written:
        clock = texts.str.to_time(written, strict=False).cast(pl.Int64)
        return np.asarray((clock.cast(pl.Float64) / 1e9).fill_null(np.nan).to_numpy())
    return _seconds(texts.str.to_datetime(written, time_unit="us", strict=False))


def _seconds(moments: pl.Series) -> FloatArray:
    return np.asarray((moments.dt.epoch("us") / 1e6).fill_null(np.nan).to_numpy())


def sample_rate_hz(time_s: FloatArray) -> float | None:
    """Return one over the usual step of time, None if time does not go on."""
    step = np.median(np.diff(time_s)) if time_s.size > 1 else 0.0
    return float(1 / step) if step > 0 else None
