"""Finds the numbers in a MATLAB 5 file without reading them; what is compressed is unfolded aside.

A file is 128 bytes and elements; an element is a tag, of its type and size, and its data. Small
data stand in the tag itself. A matrix is made of elements again: flags, dimensions, a name, and
numbers or, of a struct, the names of its fields and their matrices (MAT-File Format, MathWorks).
"""

import mmap
import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import IO, Any

import numpy as np

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.logs.spool import needing_room
from fleet_slip.words import shown

_HEADER = 128
_BYTE_ORDER_AT = 126
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_CHARACTERS = {1: "u1", 2: "u1", 4: "u2", 16: "u1", 17: "u2", 18: "u4"}
_STRUCT, _TEXT, _NUMERIC = 2, 4, range(6, 16)
"""Classes of matrices."""
_COMPLEX = 8
_DEEPEST = 50
_MOST_MATRICES = 100_000
_PIECE = 2**20

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class StoredMatrix:
    """Numbers in a file, column by column; axes of length 1 are left out of the shape."""

    file: IO[bytes]
    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    width: int | None = None
    """Characters of each row, of a vector of texts."""

    def read(self, column: int, start: int, end: int) -> Array:
        """Return some rows of a column."""
        if self.width is None:
            return self._numbers(column, start, end)
        codes = [self._numbers(place, start, end) for place in range(self.width)]
        letters = np.stack(codes, axis=1).astype("<u4")
        return letters.view(f"<U{self.width}").ravel()

    def _numbers(self, column: int, start: int, end: int) -> Array:
        first = column * self.shape[0] + start
        size = self.dtype.itemsize
        found = os.pread(self.file.fileno(), (end - start) * size, self.offset + first * size)
        return np.frombuffer(found, dtype=self.dtype)


class _DamagedError(Exception):
    """A tag is not what one can be."""


@contextmanager
def open_matrices(budget: Budget) -> Iterator[dict[str, StoredMatrix]]:
    """Open a MATLAB 5 file: all matrices of numbers or text, by path. Raises `InputError`."""
    file = budget.file
    with ExitStack() as opened:
        content = opened.enter_context(file.open("rb"))
        try:
            found = list(islice(_find_matrices(content, opened), _MOST_MATRICES + 1))
        except (_DamagedError, zlib.error, struct.error, RecursionError) as error:
            raise InputError(
                f"{shown(file)}: it is truncated or damaged: {error}. Is it complete? Copy it "
                "again."
            ) from None
        if len(found) > _MOST_MATRICES:
            raise InputError(f"{shown(file)}: more than {_MOST_MATRICES:,} matrices are not read.")
        yield dict(found)


def _find_matrices(content: IO[bytes], opened: ExitStack) -> Iterator[tuple[str, StoredMatrix]]:
    """Yield the matrices of a file; compressed ones are unfolded into a file without a name."""
    content.seek(_BYTE_ORDER_AT)
    order = ">" if content.read(2) == b"MI" else "<"
    unfolded: IO[bytes] = opened.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
    places = [0]
    with _mapped(content) as elements:
        if len(elements) < _HEADER:
            raise _DamagedError("its header is cut")
        plain = _Part(content, elements, order)
        for kind, start, end in plain.walk(_HEADER, len(elements)):
            if kind == _COMPRESSED:
                _unfold(elements, start, end, unfolded)
                places.append(unfolded.tell())
            else:
                yield from plain.matrices(kind, start, end)
    if len(places) > 1:
        unfolded.flush()
        with _mapped(unfolded) as elements:
            aside = _Part(unfolded, elements, order)
            for begin, until in pairwise(places):
                for kind, start, end in aside.walk(begin, until):
                    yield from aside.matrices(kind, start, end)


def _mapped(file: IO[bytes]) -> mmap.mmap:
    """Map a file, for a while only, or its pages would count as our memory."""
    return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _unfold(elements: mmap.mmap, start: int, end: int, sink: IO[bytes]) -> None:
    """Write what an element unfolds to."""
    unpacking = zlib.decompressobj()
    for at in range(start, end, _PIECE):
        packed = elements[at : min(at + _PIECE, end)]
        while packed:
            piece = unpacking.decompress(packed, 16 * _PIECE)
            with needing_room(sink.tell()):
                sink.write(piece)
                sink.flush()
            packed = unpacking.unconsumed_tail
    sink.write(bytes(-sink.tell() % 8))


class _Part:
    """Elements that lie one after the other, in a file and mapped from it."""

    def __init__(self, file: IO[bytes], elements: mmap.mmap, order: str) -> None:
        self._file, self._elements, self._order = file, elements, order

    def walk(self, at: int, until: int) -> Iterator[tuple[int, int, int]]:
        """Yield the type of each element, and where its data begin and end."""
        while at < until:
            (word,) = struct.unpack_from(f"{self._order}I", self._elements, at)
            if word >> 16:
                kind, size, start, following = word & 0xFFFF, word >> 16, at + 4, at + 8
                if size > 4:
                    raise _DamagedError(f"a small element of {size} bytes")
            else:
                kind, start = word, at + 8
                (size,) = struct.unpack_from(f"{self._order}I", self._elements, at + 4)
                following = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
            if start + size > until:
                raise _DamagedError(
                    f"an element of {size:,} bytes, and {max(until - start, 0):,} are left"
                )
            yield kind, start, start + size
            at = following

    def matrices(
        self, kind: int, start: int, end: int, path: str | None = None, depth: int = 0
    ) -> Iterator[tuple[str, StoredMatrix]]:
        """Yield the matrices of numbers or text in a matrix. One of other kinds is checked only."""
        if kind != _MATRIX:
            raise _DamagedError(f"an element of the type {kind}")
        if depth > _DEEPEST:
            raise _DamagedError(f"structs in structs, more than {_DEEPEST} deep")
        parts = self.walk(start, end)
        flags, sizes, name = (self._numbers(next(parts, None)) for _ in range(3))
        if flags is None or sizes is None or name is None or not flags.size:
            return  # an empty matrix, or one of a class that has another layout
        of_class, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) >> 8 & _COMPLEX)
        if path is None:
            path = name.tobytes().decode("latin-1")
            if path.startswith("__") or not path:
                return
        if of_class == _STRUCT:
            yield from self._fields(parts, path, int(np.prod(sizes)), depth)
            return
        found = next(parts, None)
        if found is not None and of_class == _TEXT and sizes.size == 2 and sizes[0] > 1:
            yield from self._text(found, path, int(sizes[0]), int(sizes[1]))
        if found is None or of_class not in _NUMERIC or is_complex:
            return
        if found[0] not in _NUMBERS:
            raise _DamagedError(f"an element of the type {found[0]}")
        dtype = np.dtype(self._order + _NUMBERS[found[0]])
        if found[2] - found[1] != int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize:
            raise _DamagedError(f"{path} has not as many values as its size says")
        shape = tuple(int(size) for size in sizes if size != 1)
        yield path, StoredMatrix(self._file, found[1], dtype, shape)

    def _text(
        self, found: tuple[int, int, int], path: str, rows: int, width: int
    ) -> Iterator[tuple[str, StoredMatrix]]:
        """Yield a matrix of characters as a vector of texts, if all are of the same size."""
        kind, start, end = found
        dtype = np.dtype(self._order + _CHARACTERS.get(kind, "V"))
        if width and end - start == rows * width * dtype.itemsize:
            yield path, StoredMatrix(self._file, start, dtype, (rows,), width)

    def _fields(
        self, parts: Iterator[tuple[int, int, int]], path: str, number: int, depth: int
    ) -> Iterator[tuple[str, StoredMatrix]]:
        """Yield the matrices in the fields of a struct; those of arrays of structs have no path."""
        length, names = self._numbers(next(parts, None)), self._numbers(next(parts, None))
        if length is None or names is None or length.size != 1 or number != 1:
            return
        if int(length[0]) < 1 or names.size % int(length[0]):
            raise _DamagedError(f"names of fields of {int(length[0]):,} bytes")
        fields = names.tobytes()
        for place in range(0, len(fields), int(length[0])):
            field = fields[place : place + int(length[0])].split(b"\0")[0].decode("latin-1")
            found = next(parts, None)
            if found is None:
                raise _DamagedError(f"the struct {path} has no {field}")
            yield from self.matrices(*found, f"{path}.{field}", depth + 1)

    def _numbers(self, found: tuple[int, int, int] | None) -> Array | None:
        """Return the few numbers of an element, None if it has others."""
        if found is None or found[0] not in _NUMBERS:
            return None
        dtype = np.dtype(self._order + _NUMBERS[found[0]])
        content = self._elements[found[1] : found[2]]
        return np.frombuffer(content[: len(content) // dtype.itemsize * dtype.itemsize], dtype)
