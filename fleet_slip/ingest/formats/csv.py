"""Reads CSV in blocks of whole lines, as text or plain numbers."""

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cached_property
from io import BufferedReader, BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import polars as pl
import pyarrow as pa

from fleet_slip.ingest.formats.file_formats import CsvFormat, PlainNumbers
from fleet_slip.ingest.formats.source import Budget, Channel, Source, find_column

# The layout of a CSV file: encoding, separator, and the lines of header and data.

BUFFER_BYTES = 2**22
MAX_LINE_BYTES = 2**20
COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""First bytes of compressed files."""


def decompressed(stream: BinaryIO) -> BinaryIO:
    """Return the text of a stream, decompressed if necessary."""
    start = stream.read(max(map(len, COMPRESSED)))
    stream.seek(0)
    for magic, codec in COMPRESSED.items():
        if start.startswith(magic):
            # Text is read in blocks: a small file may decompress to more than the memory.
            plain = pa.CompressedInputStream(stream, codec)
            return BufferedReader(plain, BUFFER_BYTES)
    return stream


def text_of(stream: BinaryIO, csv_format: CsvFormat) -> BinaryIO:
    """Return the text of a stream as UTF-8, decompressed if necessary."""
    plain = decompressed(stream)
    if csv_format.encoding == "utf-8":
        return plain
    plain = pa.transcoding_input_stream(pa.PythonFile(plain, "r"), csv_format.encoding, "utf-8")
    return BufferedReader(plain, 2**20)


def first_lines(file: Path, csv_format: CsvFormat, count: int) -> list[str]:
    """Return the first lines of a text file, decompressed if necessary."""
    with file.open("rb") as stream:
        text = text_of(stream, csv_format)
        lines = iter(lambda: text.readline(MAX_LINE_BYTES), b"")
        return [line.decode("utf-8", "replace").rstrip("\r\n") for line in islice(lines, count)]


BLOCK_BYTES = 2**22
"""CSV is parsed in blocks of about this size."""

LINE_BLOCKS = 4
"""Maximum number of blocks of one line. A longer line usually has a quote that is not closed."""

EXTRA_FIELDS = "\0extra fields"
"""Column of a CSV batch: the text of a line after the last column of the header, or null."""

CUT = "the file ends within this line"
"""Value of `EXTRA_FIELDS` for a last line without a line break and with fewer fields."""

FEWER = "fewer fields than names"
"""Value of `EXTRA_FIELDS` for a line with too few fields, in formats without empty fields."""
_FIRST_ROWS = 100
"""Number of first rows; one of them must have as many fields as the header has names."""


class CsvSource(Source):
    """A CSV file, or one that is compressed."""

    def __init__(self, budget: Budget, csv_format: CsvFormat, numbers: PlainNumbers) -> None:
        """Take a file and how it is written; it is opened to be read."""
        self._budget, self.csv_format, self._numbers = budget, csv_format, numbers

    @cached_property
    def _header(self) -> list[Channel]:
        with self._budget.file.open("rb") as stream:
            return self._read_header(text_of(stream, self.csv_format))

    def _read_header(self, stream: BinaryIO) -> list[Channel]:
        """Return all columns, and leave the stream where the data begin. Raises `InputError`."""
        layout = self.csv_format
        for _ in range(layout.header_line - 1):
            stream.readline(MAX_LINE_BYTES)
        line = stream.readline(MAX_LINE_BYTES + 1)
        fields = None
        if line.strip() and len(line) <= MAX_LINE_BYTES:
            text = _decode(line.removeprefix(b"\xef\xbb\xbf"), self._budget).rstrip("\r\n")
            fields = _fields(text, layout)
        if fields is None:
            raise self._budget.error(
                f"its line {layout.header_line} is no header of CSV: it is empty, has an open "
                f"quote, or is longer than {MAX_LINE_BYTES:,} bytes. Export it again, or set "
                "header_line under [csv] in the mapping."
            )
        for _ in range(layout.header_line + 1, layout.data_line or 0):
            stream.readline(MAX_LINE_BYTES)
        return described(fields)

    def channels(self) -> list[Channel]:
        """Return the columns of the header."""
        return [channel for channel in self._header if channel.name]

    def find(self, column: str) -> tuple[str, int]:
        """Return the position of a column. Raises `InputError`."""
        return "", find_column(self._budget.file, [c.name for c in self._header], column)

    def read(self, _base: str, places: dict[str, int]) -> Iterator[pl.DataFrame]:
        """Yield the columns as text or plain numbers, and `EXTRA_FIELDS`.

        A line that repeats the header, in any order, defines the columns of the lines after it.
        """
        with self._budget.file.open("rb") as stream:
            plain = text_of(stream, self.csv_format)
            names = [channel.name for channel in self._read_header(plain)]
            numbers, unfolded = set(self._numbers.columns & set(places)), 0
            for block in self._blocks(plain, len(names)):
                if not unfolded:
                    self._require_fields(block, names)
                unfolded += len(block)
                self._budget.require_unfolded(unfolded)
                for lines, header in self._split_at_headers(block, names):
                    yield self._parse(lines, len(names), places, numbers)
                    if header:
                        file = self._budget.file
                        places = {name: find_column(file, header, name) for name in places}
                        names = header

    def _blocks(self, stream: BinaryIO, width: int) -> Iterator[bytes]:
        """Yield blocks of UTF-8 that end with a line; a line break in quotes does not end one."""
        remainder = before = b""
        while more := stream.read(BLOCK_BYTES):
            block = remainder + more
            end = _end_of_lines(block)
            if not end and len(block) > LINE_BLOCKS * BLOCK_BYTES:
                raise self._budget.error(
                    f"a line is longer than {LINE_BLOCKS * BLOCK_BYTES:,} bytes. Is a quote not "
                    "closed?"
                )
            lines, remainder = block[:end], block[end:]
            if lines:
                _require_text(lines, self._budget)
                before = lines[lines.rfind(b"\n", 0, -1) + 1 :]
                yield lines
        if remainder:
            _require_text(remainder, self._budget)
            yield self._with_cut_marked(remainder, before, width)

    def _with_cut_marked(self, line: bytes, before: bytes, width: int) -> bytes:
        """Return the last line, with `CUT` in `EXTRA_FIELDS` if it has fewer fields than others."""
        separator = self.csv_format.separator.encode()
        separators = line.count(separator)
        if not line.strip() or b'"' in before + line:
            return line
        if separators >= min(before.count(separator), width - 1):
            return line
        return line + separator * (width - separators) + f'"{CUT}"'.encode()

    def _require_fields(self, lines: bytes, names: list[str]) -> None:
        """Raise `InputError` if all first rows have fewer fields than there are names.

        Then the missing columns are unknown.
        """
        rows = [row for row in lines.split(b"\n", _FIRST_ROWS)[:_FIRST_ROWS] if row.strip()]
        separator = self.csv_format.separator.encode()
        fields = 1 + max((row.count(separator) for row in rows), default=0)
        width = max((number for number, name in enumerate(names, 1) if name), default=0)
        if len(rows) > 1 and fields < width:
            raise self._budget.error(
                f"its header has {width} names, and its rows have {fields} fields, so that values "
                "may belong to other columns. Correct the header, or set header_line and separator "
                "under [csv] in the mapping."
            )

    def _split_at_headers(
        self, block: bytes, names: list[str]
    ) -> Iterator[tuple[bytes, list[str] | None]]:
        """Yield a block of whole lines up to each header in it, and the names of that header."""
        words = [name for name in names if not _NUMBER.fullmatch(name)]
        probe = max(words, key=len, default="").encode()
        start, place = 0, block.find(probe) if probe else -1
        while place >= 0:
            begin = block.rfind(b"\n", 0, place) + 1
            end = block.find(b"\n", place) + 1 or len(block)
            fields = _fields(block[begin:end].decode().rstrip("\r\n"), self.csv_format)
            header = [channel.name for channel in described(fields or [])]
            if len(set(header) & set(names)) >= max(2, len(set(names)) / 2):
                yield block[start:end], header
                start = end
            place = block.find(probe, end)
        yield block[start:], None

    def _parse(
        self, block: bytes, width: int, places: dict[str, int], numbers: set[str]
    ) -> pl.DataFrame:
        """Parse lines; remove columns with other values from `numbers`.

        Columns are read by position: Polars renames doubles. A line of separators before them fixes
        the number of fields, and keeps a block from looking like a compressed file.
        """
        # `ignore_errors` would also ignore bad quotes. With a decimal comma a point groups digits,
        # but Polars reads it as a decimal point.
        grouped = self.csv_format.decimal_comma and b"." in block
        parsed_numbers = set[str]() if b'"' in block or grouped else numbers
        padding = self.csv_format.separator.encode() * width + b"\n"
        fields = [f"column {i}" for i in range(width)] + [EXTRA_FIELDS]
        schema: dict[str, type[pl.DataType]] = dict.fromkeys(fields, pl.String)
        schema |= {fields[places[name]]: pl.Float64 for name in parsed_numbers}
        frame = pl.scan_csv(
            BytesIO(padding + block),
            has_header=False,
            separator=self.csv_format.separator,
            schema=schema,
            truncate_ragged_lines=True,
            ignore_errors=bool(parsed_numbers),
            decimal_comma=self.csv_format.decimal_comma,
        )
        selection = [pl.col(fields[i]).alias(name) for name, i in places.items()]
        parsed = frame.select(*selection, EXTRA_FIELDS).collect().slice(1)
        if texts := {name for name in parsed_numbers if not self._numbers.are_in(parsed[name])}:
            numbers -= texts
            return self._parse(block, width, places, numbers)
        return parsed


_WITH_KEYS = re.compile(r'"?([^"|]+)"?\|"?([^"|]*)"?(\|[-+.\d]*){1,3}')
"""A name in the header of RaceCapture: "AccelX"|"G"|-3.0|3.0|25."""


def described(fields: Sequence[str]) -> list[Channel]:
    """Return the columns of a header; equal names are numbered, as NAME@NUMBER."""
    keys = [_WITH_KEYS.fullmatch(field.strip()) for field in fields]
    names = [key[1] if key else name.strip() for key, name in zip(keys, fields, strict=True)]
    several = {name for name, count in Counter(names).items() if name and count > 1}
    unique = (f"{name}@{n}" if name in several else name for n, name in enumerate(names, 1))
    return [Channel(name, key[2] if key else "") for key, name in zip(keys, unique, strict=True)]


_NUMBER = re.compile(r"[-+\d.,eE ]*")
"""Pattern of names that may also be values of a row."""


def _fields(line: str, csv_format: CsvFormat) -> list[str] | None:
    """Return the fields of a line, None if it is not CSV."""
    if "|" in line and csv_format.separator == ",":  # quotes within a name of RaceCapture
        fields = line.split(",")
        if all(_WITH_KEYS.fullmatch(field.strip()) for field in fields):
            return fields
    try:
        return next(csv.reader([line], delimiter=csv_format.separator, strict=True), [])
    except csv.Error:
        return None


def _end_of_lines(block: bytes) -> int:
    """Return the end of the last whole line, after a line break outside of quotes."""
    end = block.rfind(b"\n") + 1
    quotes = block.count(b'"', 0, end)
    while quotes % 2:
        before = block.rfind(b"\n", 0, end - 1) + 1
        quotes -= block.count(b'"', before, end)
        end = before
    return end


def _require_text(block: bytes, budget: Budget) -> None:
    if b"\0" in block or not block.isascii():
        _decode(block, budget)


def _decode(block: bytes, budget: Budget) -> str:
    """Return text of UTF-8. Raises `InputError`."""
    problem = "binary or UTF-16, not a UTF-8 CSV file"
    if b"\0" not in block:
        try:
            return block.decode("utf-8")
        except UnicodeDecodeError as error:
            excerpt = block[error.start - min(error.start, 20) : error.start + 20]
            problem = f"not UTF-8, near {excerpt!r}"
    raise budget.error(
        f"{problem}. Write encoding under [csv] in the mapping: 'cp1252' of Western Windows, or "
        "'utf-16'; or give a Parquet file."
    )
