"""What the text of a CSV file is made of: encoding, separator, and which of its lines are data."""

import codecs
from io import BufferedReader, RawIOBase
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO, Literal

import pyarrow as pa
from pydantic import Field, field_validator, model_validator

from fleet_slip.config import Config, added

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BUFFER_BYTES = 2**22
MAX_LINE_BYTES = 2**20
COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""What compressed files begin with."""


Encoding = Literal["utf-8", "utf-16", "cp1252"]
Line = Annotated[int, Field(ge=1, le=1000)]


class CsvFormat(Config):
    """How a CSV file is written. Lines are counted from 1, as editors do.

    What came after the first release is left out of the mapping's identity where it is usual.
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

    @property
    def lines_between(self) -> int:
        """Lines between the header and the data."""
        return (self.data_line or self.header_line + 1) - self.header_line - 1


def decompressed(stream: BinaryIO) -> BinaryIO:
    """Return the text of a stream, whatever it is compressed with."""
    start = stream.read(max(map(len, COMPRESSED)))
    stream.seek(0)
    for magic, codec in COMPRESSED.items():
        if start.startswith(magic):
            # Text is read in blocks: what a small file may become is never in memory at once.
            plain = pa.CompressedInputStream(stream, codec)
            return BufferedReader(plain, BUFFER_BYTES)
    return stream


class _Recoded(RawIOBase):
    """A stream of text in another encoding, as UTF-8."""

    def __init__(self, stream: BinaryIO, encoding: Encoding) -> None:
        self._stream, self._rest = stream, b""
        self._decoder = codecs.getincrementaldecoder(encoding)()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: "WriteableBuffer") -> int:
        room, ended = memoryview(buffer).cast("B"), False
        while not self._rest and not ended:
            more = self._stream.read(max(len(room) // 4, 1024))
            ended = not more
            self._rest = self._decoder.decode(more, final=ended).encode()
        taken, self._rest = self._rest[: len(room)], self._rest[len(room) :]
        room[: len(taken)] = taken
        return len(taken)


def recoded(stream: BinaryIO, encoding: Encoding) -> BinaryIO:
    """Return text in another encoding as UTF-8."""
    return stream if encoding == "utf-8" else BufferedReader(_Recoded(stream, encoding), 2**20)


def text_of(stream: BinaryIO, csv_format: CsvFormat) -> BinaryIO:
    """Return the UTF-8 text of a stream, whatever it is compressed with."""
    return recoded(decompressed(stream), csv_format.encoding)


def first_lines(file: Path, csv_format: CsvFormat, most: int) -> list[str]:
    """Return the first lines of a text file, whatever it is compressed with."""
    with file.open("rb") as stream:
        text = text_of(stream, csv_format)
        lines = iter(lambda: text.readline(MAX_LINE_BYTES), b"")
        return [line.decode("utf-8", "replace").rstrip("\r\n") for line in islice(lines, most)]
