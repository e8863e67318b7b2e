"""Reads MATLAB files, version 5, and 7.3 (HDF5) through h5py, some rows at once.

A column is the path of a vector, `Data.Vehicle.yawRate`, or one column of a matrix, `wheels(:,2)`.
"""

import mmap
import os
import re
import struct
import tempfile
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import IO, Any, Protocol

import numpy as np
import polars as pl

from fleet_slip.base import shown
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.source import (
    Budget,
    Channel,
    as_column,
    describe_missing,
    needing_room,
    reading_with,
)

# Finds the numbers in a MATLAB 5 file without reading them; what is compressed is unfolded aside.
#
# A file is 128 bytes and elements; an element is a tag, of its type and size, and its data. Small
# data stand in the tag itself. A matrix is made of elements again: flags, dimensions, a name, and
# numbers or, of a struct, the names of its fields and their matrices (MAT-File Format, MathWorks).

_HEADER = 128
_BYTE_ORDER_AT = 126
_MATRIX, _COMPRESSED = 14, 15
_DTYPES = {
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
        if found[0] not in _DTYPES:
            raise _DamagedError(f"an element of the type {found[0]}")
        dtype = np.dtype(self._order + _DTYPES[found[0]])
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
        if found is None or found[0] not in _DTYPES:
            return None
        dtype = np.dtype(self._order + _DTYPES[found[0]])
        content = self._elements[found[1] : found[2]]
        return np.frombuffer(content[: len(content) // dtype.itemsize * dtype.itemsize], dtype)


_COLUMN = re.compile(r"(.+)\(:,(\d+)\)")
_MOST_COLUMNS = 64
_NUMBERS = re.compile(r"u?int(8|16|32|64)|double|single|logical")
_PACKED = {"scale_factor", "add_offset"}
"""What netCDF says of counts in a dataset."""
WINDOW_ROWS = 2**15
"""Rows that are read at once."""


class _Matrix(Protocol):
    """A matrix in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of its axes."""
        ...

    def read(self, column: int, start: int, end: int) -> Array:
        """Return some rows of a column."""
        ...


class MatSource:
    """The vectors of an open MATLAB file. Time is one of them."""

    has_clock = False

    def __init__(
        self,
        matrices: Mapping[str, _Matrix],
        budget: Budget,
        links: Collection[str] = (),
        packed: Collection[str] = (),
    ) -> None:
        """Take its matrices by path, and the names of links and of packed counts."""
        self._file, self._matrices = budget.file, matrices
        self._links, self._packed = links, packed

    def channels(self) -> list[Channel]:
        """Return all vectors, and the columns of matrices."""
        found = []
        for path, matrix in self._matrices.items():
            rows, columns = _rows_columns(matrix.shape)
            names = [path] if columns == 1 else [f"{path}(:,{i + 1})" for i in range(columns)]
            if rows > 1 and columns <= _MOST_COLUMNS:
                unit = getattr(matrix, "unit", "")  # MATLAB knows none
                found += [Channel(name, unit, f"{rows} rows") for name in names]
        return found

    def expected_rows(self, columns: Sequence[str]) -> int:
        """Return how many rows the first of some columns has."""
        return _rows_columns(self.find(columns[0])[0].shape)[0]

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield all rows, some at once. Raises `InputError` if columns differ in length."""
        found = {name: self.find(name) for name in columns}
        lengths = {name: _rows_columns(matrix.shape)[0] for name, (matrix, _) in found.items()}
        first, rows = next(iter(lengths.items()))
        for name, length in lengths.items():
            if length != rows:
                raise InputError(
                    f"{shown(self._file)}: {name!r} has {length:,} values and {first!r} has "
                    f'{rows:,}. Give the signal the time that goes with it: time = "…".'
                )
        for start in range(0, max(rows, 1), WINDOW_ROWS):
            end = min(start + WINDOW_ROWS, rows)
            yield pl.DataFrame(
                as_column(self._file, name, matrix.read(column, start, end)).alias(name)
                for name, (matrix, column) in found.items()
            )

    def find(self, name: str) -> tuple[_Matrix, int]:
        """Return a matrix, and which of its columns is meant. Raises `InputError`."""
        whole = self._matrices.get(name)
        if whole is not None:
            if _rows_columns(whole.shape)[1] != 1:
                axes = " x ".join(map(str, whole.shape)) or "1"
                raise InputError(
                    f"{shown(self._file)}: channel {name!r} has {axes} values, not one a row. Map "
                    "one of its columns."
                )
            return whole, 0
        found = _COLUMN.fullmatch(name)
        matrix = self._matrices.get(found[1]) if found else None
        if found and matrix and 1 <= int(found[2]) <= _rows_columns(matrix.shape)[1]:
            return matrix, int(found[2]) - 1
        if any(f"{name}.".startswith(f"{link}.") for link in self._links):
            raise InputError(
                f"{shown(self._file)}: {name!r} is a link, which is not followed. Map what it "
                "links to."
            )
        if name in self._packed:
            raise InputError(
                f"{shown(self._file)}: {name!r} has counts, with {' and '.join(sorted(_PACKED))} "
                "of netCDF, which are not applied. Export it again with physical values."
            )
        names = [channel.name for channel in self.channels()]
        raise InputError(f"{shown(self._file)}: {describe_missing(name, names)}")


class _Dataset:
    """A dataset of HDF5, which has the axes of MATLAB in reverse."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self.shape = tuple(size for size in reversed(dataset.shape) if size != 1)

    def read(self, column: int, start: int, end: int) -> Array:
        """Return some rows of a column."""
        wanted = iter([column, slice(start, end)][-len(self.shape) :])
        places = tuple(0 if size == 1 else next(wanted) for size in self._dataset.shape)
        return np.asarray(self._dataset[places])


def _rows_columns(shape: Sequence[int]) -> tuple[int, int]:
    """Return rows and columns; what has more axes has no rows of one value."""
    if len(shape) == 1:
        return shape[0], 1
    return (shape[0], shape[1]) if len(shape) == 2 else (0, 0)


@contextmanager
def open_mat(budget: Budget) -> Iterator[MatSource]:
    """Open a MATLAB file of version 5 to 7. Raises `InputError`."""
    with open_matrices(budget) as matrices:
        yield MatSource({path: one for path, one in matrices.items() if one.shape}, budget)


@contextmanager
def open_mat73(budget: Budget) -> Iterator[MatSource]:
    """Open a MATLAB file of version 7.3, or any HDF5 file. Raises `InputError`.

    HDF5 can take the values of a dataset out of any other file. That is asked of each dataset
    before anything else, its size among it: the library opens those files to tell it. Links are
    not followed.
    """
    file = budget.file
    with reading_with(file, "h5py") as h5py, h5py.File(file, "r") as root:
        matrices: dict[str, _Dataset] = {}
        links: list[str] = []
        packed: list[str] = []

        def visit(path: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or path.startswith("#refs#"):
                return
            layout = item.id.get_create_plist()
            if layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
                raise InputError(
                    f"{shown(file)}: the values of {path!r} are in other files. Export it again "
                    "with all values in one file."
                )
            if _PACKED & set(item.attrs):
                packed.append(path.replace("/", "."))
            elif item.shape and item.dtype.kind in "iufb" and _is_plain(item.attrs):
                matrices[path.replace("/", ".")] = _Dataset(item)

        def note(path: str, link: Any) -> None:
            if not isinstance(link, h5py.HardLink):
                links.append(path.replace("/", "."))

        root.visititems(visit)
        root.visititems_links(note)
        yield MatSource(matrices, budget, links, packed)


def _is_plain(attributes: Any) -> bool:
    """Whether a dataset has values of its own: of an object it has references, or only sizes."""
    kind = attributes.get("MATLAB_class", "double")
    kind = kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)
    return bool(_NUMBERS.fullmatch(kind)) and "MATLAB_empty" not in attributes
