"""Guesses how a text file is written: encoding, separator, and where header, units and data are."""

import csv
import re
from collections import Counter
from pathlib import Path

from fleet_slip.ingest.formats.csv_text import CsvFormat, Encoding, decompressed, first_lines
from fleet_slip.ingest.mapping.vocabulary import unit_called

_SEPARATORS = (";", "\t", "|", ",", " ")
_LINES = 120
_NUMBER = re.compile(r"\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?\s*")
_DECIMAL_COMMA = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*")
_BOMS = (b"\xff\xfe", b"\xfe\xff")


def guess_layout(file: Path) -> tuple[CsvFormat, dict[str, str]]:
    """Return how a text file is written, and the units of its columns if a line has them."""
    encoding = _guess_encoding(file)
    if encoding is None:
        return CsvFormat(), {}
    lines = first_lines(file, CsvFormat(encoding=encoding), _LINES)
    if not lines:
        return CsvFormat(encoding=encoding), {}
    separator = max(_SEPARATORS, key=lambda one: _regularity(lines, one))
    rows = [_split(line, separator) for line in lines]
    header, data = _header_and_data(rows)
    fields = [field for row in rows[data:] for field in row]
    given = CsvFormat(
        separator=separator,
        decimal_comma=separator != "," and any(_DECIMAL_COMMA.fullmatch(f) for f in fields),
        encoding=encoding,
        header_line=header + 1,
        data_line=data + 1 if data > header + 1 else None,
    )
    return given, _units(rows[header], rows[header + 1 : data])


def _guess_encoding(file: Path) -> Encoding | None:
    """Return the encoding of a text, None for what is no text."""
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
    """Return how well a separator splits lines.

    Which part of the last lines has numbers in equally many fields, whether a line above them has
    as many, which part has whatever is in them, and how many they are.
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
    """Return the places of the header and of the first line of data; 0 and 1 if nothing tells.

    Above the data are lines of as many fields, the first of which is the header; a blank line or a
    title in brackets may be between.
    """
    width = Counter(map(len, rows[len(rows) // 2 :])).most_common(1)[0][0]
    data = next((i for i, row in enumerate(rows) if len(row) == width and _is_data(row)), None)
    if not data:
        return 0, 1
    header, found = data, 0
    for place in range(data - 1, -1, -1):
        row = rows[place]
        if len(row) == width and sum(bool(field.strip()) for field in row) > width / 2:
            header, found = place, found + 1
        elif "".join(row).strip() and not re.fullmatch(r"\s*\[.*\]\s*", "".join(row)):
            break
        if found == 3:
            break
    return (header, data) if found else (0, 1)


def _is_data(row: list[str]) -> bool:
    some = [field for field in row if field.strip()]
    numbers = sum(_NUMBER.fullmatch(field) is not None for field in some)
    return bool(some) and numbers >= max(len(some) / 2, 1)


def _units(header: list[str], between: list[list[str]]) -> dict[str, str]:
    """Return the units of columns, from a line of as many fields in which one is a unit."""
    for row in between:
        if len(row) == len(header) and any(unit_called(field) for field in row):
            told = zip(header, row, strict=True)
            return {name.strip(): unit.strip(" []()") for name, unit in told}
    return {}
