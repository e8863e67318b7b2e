"""Where the times of a log are from."""

import warnings
from datetime import UTC, datetime
from functools import cache
from typing import Annotated
from zoneinfo import available_timezones

import polars as pl
from pydantic import Field, field_validator, model_validator

from fleet_slip.config import Config, Name, PositiveFloat, added
from fleet_slip.ingest.formats.log_source import OWN_TIME
from fleet_slip.ingest.mapping.units import require_unit


class DateColumn(Config):
    """The column of dates beside one of times of the day, and its strftime codes."""

    column: Name
    format: Name = "%Y-%m-%d"


class TimeBase(Config):
    """Where time is from, and which gaps are bridged or end a drive.

    Either `column` with a `unit` (numbers) or a `format` (timestamps as text, strftime codes; naive
    ones are UTC, or of a `zone`; a Parquet timestamp column needs no format; a `date` may stand in
    a column of its own), or `rate_hz` for equally spaced rows, or `own_clock` for a format that
    says itself when a sample was taken.
    """

    column: Name | None = None
    unit: str | None = None
    format: Name | None = None
    date: DateColumn | None = added(None)
    rate_hz: Annotated[float, Field(ge=1, le=100_000)] | None = None
    epoch: bool = added(False)
    """Numbers are counted from 1970, in UTC, so that they tell the date."""
    zone: str | None = added(None)
    """Where the clock of timestamps without a zone stands, such as `Europe/Berlin`."""
    assumed: bool = added(False)
    """Nobody knows the rate: each ingest says so."""
    own_clock: bool = added(False)
    longest_gap_s: Annotated[PositiveFloat, Field(le=10)] = 0.1
    """Samples of a signal that lie further apart are not interpolated between."""
    split_gap_s: Annotated[PositiveFloat, Field(le=60)] = 1.0
    """A step in time larger than this, forward or back, begins a new drive."""

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, text: str | None) -> str | None:
        if text is not None and not (_reads_back(text) or reads_clock(text)):
            raise ValueError(f"{text!r} is not a strftime format with date and time, or with time")
        return text

    @field_validator("zone")
    @classmethod
    def _zone_is_known(cls, zone: str | None) -> str | None:
        if zone is not None and zone not in available_timezones():
            raise ValueError(f"{zone!r} is no time zone. Write it as 'Europe/Berlin'")
        return zone

    @model_validator(mode="after")
    def _consistent(self) -> "TimeBase":
        if [self.column is None, self.rate_hz is None, not self.own_clock].count(False) != 1:
            raise ValueError(
                "needs either 'column' or 'rate_hz', or 'own_clock' for files with clocks, as MDF"
            )
        if self.column is None and (self.unit is not None or self.format is not None):
            raise ValueError("'unit' and 'format' describe a column, and there is none")
        if self.unit is not None and self.format is not None:
            raise ValueError("'unit' is for numbers and 'format' for timestamps: give one of them")
        if self.epoch and self.unit is None:
            raise ValueError("'epoch' is for numbers: give their 'unit'")
        if self.assumed and self.rate_hz is None:
            raise ValueError("'assumed' is for a rate_hz that nobody knows")
        if self.date is not None:
            if self.format is None or not reads_clock(self.format):
                raise ValueError("'date' stands beside a column whose format has the time alone")
            if not _reads_back(str(self.moment_format)):
                raise ValueError(f"{self.date.format!r} is not a strftime format of a date")
        zoned = self.format is not None and "%z" in self.format
        if self.zone is not None and (zoned or self.unit is not None or self.column is None):
            raise ValueError("'zone' is for timestamps that do not say theirs")
        if self.longest_gap_s > self.split_gap_s:
            raise ValueError("longest_gap_s cannot be larger than split_gap_s")
        if self.unit is not None:
            try:
                require_unit(self.unit, "s")
            except ValueError as error:
                raise ValueError(f"{self.column} {error}") from None
        return self

    @property
    def is_dated(self) -> bool:
        """Whether times can tell the day."""
        if self.unit is not None or self.rate_hz is not None:
            return self.epoch
        if self.date is not None:
            return True
        return self.format is None or not reads_clock(self.format)

    @property
    def moment_format(self) -> str | None:
        """The format of a text, the date before it if that stands in a column of its own."""
        return self.format if self.date is None else f"{self.date.format} {self.format}"

    @property
    def key(self) -> str | None:
        """The column that has the times of a batch, None if the rows are equally spaced."""
        return OWN_TIME if self.own_clock else self.column


def as_moments(text: pl.Expr, timestamp_format: str) -> pl.Expr:
    """Return texts as timestamps, null where they are none.

    Polars warns of `%f` with the place in our code; what comes of a wrong one, ingest tells.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pl.exceptions.ChronoFormatWarning)
        return text.str.to_datetime(timestamp_format, time_unit="us", strict=False)


def _reads_back(timestamp_format: str) -> bool:
    """Whether a moment that is written in this format can be read, to the minute."""
    moment = datetime(2024, 5, 31, 12, 34, tzinfo=UTC)
    try:
        written = pl.Series([moment]).dt.to_string(timestamp_format)
        read = written.to_frame().select(as_moments(pl.col(written.name), timestamp_format))[0, 0]
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
        return False
    return isinstance(read, datetime) and read.replace(tzinfo=UTC) == moment


@cache
def reads_clock(timestamp_format: str) -> bool:
    """Whether a format has the time of day and no date."""
    if _reads_back(timestamp_format):
        return False
    try:
        written = pl.Series(["12:34:00"]).str.to_time("%H:%M:%S").dt.to_string(timestamp_format)
        return bool(written.str.to_time(timestamp_format, strict=False).is_not_null().all())
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
        return False
