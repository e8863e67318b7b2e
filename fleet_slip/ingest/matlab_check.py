"""Looks at the tags of a MATLAB 5 file before scipy does, which a wrong one would bring down.

A file is 128 bytes and elements; an element is a tag, of its type and size, and its data. Small
data stand in the tag itself. A matrix is made of elements again (MAT-File Format, MathWorks).
"""

import struct
import zlib
from pathlib import Path

from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import shown

_HEADER = 128
_BYTE_ORDER_AT = 126
_MATRIX, _COMPRESSED = 14, 15
_DATA = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18})
_DEEPEST = 50
_LARGEST = 2**30


class _DamagedError(Exception):
    """A tag is not what one can be."""


def require_sound_tags(file: Path) -> None:
    """Raise `InputError` for a MATLAB 5 file with tags that no file has."""
    content = memoryview(file.read_bytes())
    order = ">" if bytes(content[_BYTE_ORDER_AT:_HEADER]) == b"MI" else "<"
    try:
        _check(content[_HEADER:], order, 0)
    except (_DamagedError, zlib.error, struct.error) as error:
        raise InputError(
            f"{shown(file)}: it is truncated or damaged: {error}. Is it complete? Copy it again."
        ) from None


def _check(elements: memoryview, order: str, depth: int) -> None:
    at = 0
    while at < len(elements):
        kind, data, following = _element(elements, at, order)
        if kind == _COMPRESSED and not depth:
            _check(memoryview(_unpacked(data)), order, depth + 1)
        elif kind == _MATRIX and depth < _DEEPEST:
            _check(data, order, depth + 1)
        elif kind not in _DATA or not depth:
            raise _DamagedError(f"an element of the type {kind}")
        at = following


def _element(elements: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Return the type of an element, its data, and where the next one begins."""
    (word,) = struct.unpack_from(f"{order}I", elements, at)
    if word >> 16:
        kind, size, start, following = word & 0xFFFF, word >> 16, at + 4, at + 8
        if size > 4:
            raise _DamagedError(f"a small element of {size} bytes")
    else:
        kind, start = word, at + 8
        (size,) = struct.unpack_from(f"{order}I", elements, at + 4)
        following = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
    if start + size > len(elements):
        raise _DamagedError(f"an element of {size:,} bytes, and {len(elements) - start:,} are left")
    return kind, elements[start : start + size], following


def _unpacked(data: memoryview) -> bytes:
    unpacking = zlib.decompressobj()
    content = unpacking.decompress(data, _LARGEST)
    if unpacking.unconsumed_tail:
        raise _DamagedError(f"a compressed element of more than {_LARGEST:,} bytes")
    return content
