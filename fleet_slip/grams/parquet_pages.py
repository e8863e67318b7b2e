"""Reads the footer and the page headers of a Parquet file, before anything is decoded.

They are structs in the compact protocol of Thrift (`parquet.thrift`). pyarrow does not expose page
headers, and aborts the process for some damaged footers if asked for a column of a row group.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

_DATA, _DICTIONARY, _DATA_V2 = 5, 7, 8
_MAGIC, _TAIL_BYTES = b"PAR1", 8
_MAX_FOOTER_BYTES = 2**24
"""Size of a footer: parsing a larger one would take too much memory."""
_MAX_HEADER_BYTES, _DEEPEST, _MAX_VARINT_BYTES = 2**16, 12, 10


class ColumnChunk(NamedTuple):
    """The pages of a column in a row group: `start` and `size` are their place in the file."""

    column: str
    values: int
    start: int
    size: int
    is_in_other_file: bool


class RowGroup(NamedTuple):
    """Rows of a file that are stored together."""

    rows: int
    chunks: tuple[ColumnChunk, ...]


class PageHeader(NamedTuple):
    """The parts of a page's header that bound what it decodes to."""

    size_bytes: int
    values: int
    has_checksum: bool
    is_dictionary: bool


def read_row_groups(content: bytes) -> list[RowGroup]:
    """Return the row groups of a file. Raises `ValueError` for damage, and for a large footer."""
    tail = content[-_TAIL_BYTES:]
    size = int.from_bytes(tail[:4], "little")
    if tail[4:] != _MAGIC or size > min(_MAX_FOOTER_BYTES, len(content) - _TAIL_BYTES):
        raise ValueError("a file without a footer, or with a large one")
    end = len(content) - _TAIL_BYTES
    try:
        footer, _ = _read_struct(memoryview(content)[end - size : end], 0)
    except IndexError:
        raise ValueError("the footer ends in a struct") from None
    groups = _checked(footer, 4, list) if footer.get(3) else []
    return [
        RowGroup(_checked(group, 3, int), tuple(map(_column_chunk, _checked(group, 1, list))))
        for group in groups
    ]


def _column_chunk(fields: Any) -> ColumnChunk:
    about = _checked(fields, 3, dict)
    offsets = (_checked(about, 9, int), _checked(about, 11, int) if 11 in about else 0)
    path = _checked(about, 3, list)
    if not path or not all(isinstance(name, bytes) for name in path):
        raise ValueError("a column without a name")
    return ColumnChunk(
        path[0].decode(),
        _checked(about, 5, int),
        min((offset for offset in offsets if offset), default=0),
        _checked(about, 7, int),
        is_in_other_file=1 in fields,
    )


def read_page_headers(content: bytes, chunk: ColumnChunk) -> Iterator[PageHeader]:
    """Yield the headers of a column's pages. Raises `ValueError` or `IndexError` for damage."""
    view, at = memoryview(content), chunk.start
    while at < chunk.start + chunk.size:
        fields, length = _read_struct(view[at : at + _MAX_HEADER_BYTES], 0)
        kind = next((kind for kind in (_DATA, _DICTIONARY, _DATA_V2) if kind in fields), 0)
        about = _checked(fields, kind, dict)
        yield PageHeader(
            _checked(fields, 2, int),
            _checked(about, 1, int),
            has_checksum=4 in fields,
            is_dictionary=kind == _DICTIONARY,
        )
        at += length + _checked(fields, 3, int)


def _checked(fields: Any, number: int, kind: type) -> Any:
    """Return a field of a struct. Raises `ValueError` if it is missing, negative or no `kind`."""
    value = fields.get(number) if isinstance(fields, dict) else None
    if not isinstance(value, kind) or (isinstance(value, int) and value < 0):
        raise ValueError(f"the field {number} of a struct is not as it must be")
    return value


def _read_struct(content: memoryview, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """Return the fields of a struct by their numbers, and the position behind it."""
    fields: dict[int, Any] = {}
    number = 0
    while byte := content[at]:
        at += 1
        if step := byte >> 4:
            number += step
        else:
            number, at = _read_integer(content, at)
        kind = byte & 15
        if kind in {1, 2}:  # the type of a Boolean field is its value
            fields[number] = kind == 1
        else:
            fields[number], at = _read_value(content, at, kind, depth)
    return fields, at + 1


def _read_value(content: memoryview, at: int, kind: int, depth: int) -> tuple[Any, int]:
    """Return a value of a type, and the position behind it."""
    if depth > _DEEPEST:
        raise ValueError("structs are nested too deeply")
    match kind:
        case 1 | 2 | 3:
            return content[at], at + 1
        case 4 | 5 | 6:
            return _read_integer(content, at)
        case 7:
            return None, at + 8
        case 8:
            size, at = _read_varint(content, at)
            return bytes(content[at : at + size]), at + size
        case 9 | 10:
            return _read_list(content, at, depth)
        case 12:
            return _read_struct(content, at, depth + 1)
    raise ValueError("a type that Parquet does not use")


def _read_list(content: memoryview, at: int, depth: int) -> tuple[list[Any], int]:
    size, kind = content[at] >> 4, content[at] & 15
    at += 1
    if size == 15:
        size, at = _read_varint(content, at)
    values = []
    for _ in range(size):
        value, at = _read_value(content, at, kind, depth + 1)
        values.append(value)
    return values, at


def _read_integer(content: memoryview, at: int) -> tuple[int, int]:
    zigzag, at = _read_varint(content, at)
    return (zigzag >> 1) ^ -(zigzag & 1), at


def _read_varint(content: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for place in range(_MAX_VARINT_BYTES):
        byte = content[at + place]
        value |= (byte & 0x7F) << (7 * place)
        if byte < 0x80:
            return value, at + place + 1
    raise ValueError("a number is too long")
