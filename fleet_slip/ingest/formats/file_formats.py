"""The keys of a mapping that describe how a file is written: text, CAN database, time zone."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import polars as pl
from pydantic import Field, field_validator, model_validator

from fleet_slip.config import Config, Name, added, read_named_file
from fleet_slip.errors import ConfigError

Encoding = Literal["utf-8", "utf-16", "cp1252"]
Line = Annotated[int, Field(ge=1, le=1000)]


class CsvFormat(Config):
    """How a CSV file is written. Lines are counted from 1, as editors do.

    Keys that came after the first release are not part of the mapping's identity at their default.
    """

    separator: str = ","
    decimal_comma: bool = False
    encoding: Encoding = added("utf-8")
    """UTF-8 is with or without a byte order mark."""
    header_line: Line = added(1)
    """The line with the names of the columns; those above it are passed over."""
    data_line: Line | None = added(None)
    """The first line of data, if it is not the next: a line of units may be between."""

    @field_validator("separator")
    @classmethod
    def _one_character(cls, separator: str) -> str:
        if len(separator) != 1 or not separator.isascii() or separator in '"\r\n\0':
            raise ValueError("must be one ASCII character such as ',', ';' or a tab")
        return separator

    @model_validator(mode="after")
    def _unambiguous(self) -> "CsvFormat":
        if self.decimal_comma and self.separator == ",":
            raise ValueError("with decimal_comma the separator cannot be ',': set it, often ';'")
        if self.data_line is not None and self.data_line <= self.header_line:
            raise ValueError("data_line must come after header_line")
        return self


@dataclass(frozen=True)
class PlainNumbers:
    """Columns that are used only as numbers, and numbers that mean "no value".

    They are parsed as numbers at once, three times as fast as by way of text. A column in which a
    text is empty, is not a number or means "no value" is read as text.
    """

    columns: frozenset[str] = frozenset()
    missing: tuple[float, ...] = ()

    def are_in(self, column: pl.Series) -> bool:
        """Return True if a column that was parsed as numbers has one in every row."""
        if column.null_count() or not column.is_finite().all():
            return False
        return not (self.missing and column.is_in(self.missing).any())


# The keys of a mapping for CAN traces: the database of messages, and the bus.

DATABASES = {".dbc": "dbc", ".kcd": "kcd", ".sym": "sym"}
MAX_DATABASE_BYTES = 2**28


class CanBus(Config):
    """The database of a CAN trace. Its content, not its path, is part of a mapping's identity."""

    database: Name = Field(exclude=True)
    """Path of a DBC, KCD or SYM file, seen from the mapping's own."""
    channel: Name | None = None
    """The bus, as the trace calls it; needed where a message occurs on several."""
    text: str = Field(default="", exclude=True, repr=False)
    """The content of the database, read when the mapping is loaded."""
    digest: str = ""
    """SHA-256 of it."""

    @property
    def format(self) -> str:
        """The encoding of the database."""
        return DATABASES[Path(self.database).suffix.lower()]


def read_can_database(bus: CanBus, folder: Path) -> CanBus:
    """Return the bus with the content of its database. Raises `ConfigError`."""
    file = folder / bus.database
    if file.suffix.lower() not in DATABASES:
        raise ConfigError(
            f"{file}: not a CAN database ({', '.join(DATABASES)}). Convert ARXML with "
            "canconvert, which is part of canmatrix."
        )
    content = read_named_file(file, MAX_DATABASE_BYTES)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")  # what most tools on Windows write
    digest = hashlib.sha256(content).hexdigest()
    return bus.model_copy(update={"text": text, "digest": digest})


@dataclass(frozen=True)
class FileFormats:
    """Parameters of a file's format that the file does not contain.

    Attributes
    ----------
    csv
        Separator and decimal sign of text.
    can
        The database of a CAN trace.
    name
        The mapping, for messages.
    plain_numbers
        Columns of text that are numbers wherever they are used.
    zone
        Time zone of clocks without one; UTC if there is none.
    compared_numbers
        Columns that conditions compare with numbers alone, and those of `one_of` as text.
    """

    csv: CsvFormat = field(default_factory=CsvFormat)
    can: CanBus | None = None
    name: str = "mapping suggest"
    plain_numbers: PlainNumbers = field(default_factory=PlainNumbers)
    zone: str | None = None
    compared_numbers: Mapping[str, frozenset[str]] = field(default_factory=dict)

    def reads_number(self, column: str, names: Iterable[str]) -> bool:
        """Return True if the number of a named state is used, which has one of these names."""
        if column in self.plain_numbers.columns:
            return True
        numbers = self.compared_numbers.get(column)
        return numbers is not None and numbers.isdisjoint(names)
