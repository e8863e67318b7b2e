"""Reads MATLAB files: version 5 to 7 through scipy, 7.3 (HDF5) through h5py, some rows at once.

A column is the path of a vector, `Data.Vehicle.yawRate`, or one column of a matrix, `wheels(:,2)`.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import (
    Budget,
    Channel,
    FormatSource,
    as_column,
    load_library,
    missing_column,
)

_COLUMN = re.compile(r"(.+)\(:,(\d+)\)")
_MAX_COLUMNS = 64
_NUMBERS = re.compile(r"u?int(8|16|32|64)|double|single|logical")
_PACKED = {"scale_factor", "add_offset"}
"""Attributes of netCDF for integers that encode physical values."""
_LINK = "is a link, which is not followed. Map what it links to."
_COUNTS = (
    f"has counts, with {' and '.join(sorted(_PACKED))} of netCDF, which are not applied. Export it "
    "again with physical values."
)
WINDOW_ROWS = 2**15
"""Rows that are read at once."""

Array = np.ndarray[Any, Any]


class Matrix:
    """An array of HDF5, with the axes of MATLAB reversed. Axes of length 1 are ignored."""

    unit = ""
    """Empty: neither MATLAB nor HDF5 has units."""

    def __init__(self, values: Any) -> None:
        """Take an array of numpy or a dataset of h5py."""
        self._values = values
        self.shape = tuple(size for size in reversed(values.shape) if size != 1)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns. Arrays with more axes are no signals."""
        if len(self.shape) == 1:
            return self.shape[0], 1
        return (self.shape[0], self.shape[1]) if len(self.shape) == 2 else (0, 0)

    def read(self, column: int, start: int, end: int) -> Array:
        """Return some rows of a column."""
        indices = iter([column, slice(start, end)][-len(self.shape) :])
        places = tuple(0 if size == 1 else next(indices) for size in self._values.shape)
        return np.asarray(self._values[places])


class Vectors(FormatSource):
    """The vectors of an open file. Time is one of them."""

    has_clock = False

    def __init__(
        self, matrices: Mapping[str, Matrix], budget: Budget, refused: Mapping[str, str]
    ) -> None:
        """Take its matrices by path, and why others are not read."""
        self._file, self._matrices, self._refused = budget.file, matrices, refused

    def channels(self) -> list[Channel]:
        """Return all vectors, and the columns of matrices."""
        channels = []
        for path, matrix in self._matrices.items():
            rows, columns = matrix.size
            names = [path] if columns == 1 else [f"{path}(:,{i + 1})" for i in range(columns)]
            if rows > 1 and columns <= _MAX_COLUMNS:
                channels += [Channel(name, matrix.unit, f"{rows} rows") for name in names]
        return channels

    def find(self, column: str) -> tuple[str, tuple[Matrix, int]]:
        """Return a matrix, and which of its columns is meant. Raises `InputError`."""
        matrix_of_name = self._matrices.get(column)
        if matrix_of_name is not None:
            if matrix_of_name.size[1] != 1:
                axes = " x ".join(map(str, matrix_of_name.shape)) or "1"
                raise InputError(
                    f"{quote_name(self._file)}: channel {column!r} has {axes} values, not one a "
                    "row. "
                    "Map one of its columns."
                )
            return "", (matrix_of_name, 0)
        match = _COLUMN.fullmatch(column)
        matrix = self._matrices.get(match[1]) if match else None
        if match and matrix and 1 <= int(match[2]) <= matrix.size[1]:
            return "", (matrix, int(match[2]) - 1)
        for path, why in self._refused.items():
            if f"{column}.".startswith(f"{path}."):
                raise InputError(f"{quote_name(self._file)}: {column!r} {why}")
        raise missing_column(self._file, column, [channel.name for channel in self.channels()])

    def read(self, _base: str, places: dict[str, tuple[Matrix, int]]) -> Iterator[pl.DataFrame]:
        """Yield all rows, some at once. Raises `InputError` if columns differ in length."""
        first, (matrix, _) = next(iter(places.items()))
        rows, _ = matrix.size
        for name, (matrix, _) in places.items():
            if (length := matrix.size[0]) != rows:
                raise InputError(
                    f"{quote_name(self._file)}: {name!r} has {length:,} values and {first!r} has "
                    f'{rows:,}. Give the signal the time that goes with it: time = "…".'
                )
        for start in range(0, max(rows, 1), WINDOW_ROWS):
            end = min(start + WINDOW_ROWS, rows)
            yield pl.DataFrame(
                as_column(self._file, name, matrix.read(column, start, end)).alias(name)
                for name, (matrix, column) in places.items()
            )


@contextmanager
def open_mat(budget: Budget, _formats: FileFormats) -> Iterator[Vectors]:
    """Open a MATLAB file of version 5 to 7, which is then in memory. Raises `InputError`."""
    with budget.file.open("rb") as stream:
        content = load_library(budget.file, "scipy.io").loadmat(stream, simplify_cells=True)
    variables = {name: value for name, value in content.items() if not name.startswith("__")}
    yield Vectors(dict(_arrays_in(variables)), budget, {})


def _arrays_in(variables: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Matrix]]:
    """Yield the matrices of numbers or text in a struct, by path."""
    for name, value in variables.items():
        if isinstance(value, dict):
            yield from _arrays_in(value, f"{above}{name}.")
        elif isinstance(value, np.ndarray) and value.ndim and value.dtype.kind in "iufbU":
            yield f"{above}{name}", Matrix(value.T)


@contextmanager
def open_mat73(budget: Budget, _formats: FileFormats) -> Iterator[Vectors]:
    """Open a MATLAB file of version 7.3, or any HDF5 file. Raises `InputError`.

    HDF5 can take the values of a dataset out of any other file. That is asked of each dataset
    before anything else, its size among it: the library opens those files for it. Links are
    not followed.
    """
    file = budget.file
    h5py = load_library(file, "h5py")
    with h5py.File(file, "r") as root:
        matrices: dict[str, Matrix] = {}
        refused: dict[str, str] = {}

        def visit(path: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or path.startswith("#refs#"):
                return
            layout = item.id.get_create_plist()
            if layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
                raise InputError(
                    f"{quote_name(file)}: the values of {path!r} are in other files. Export it "
                    "again "
                    "with all values in one file."
                )
            if _PACKED & set(item.attrs):
                refused[path.replace("/", ".")] = _COUNTS
            elif item.shape and item.dtype.kind in "iufb" and _is_plain(item.attrs):
                matrices[path.replace("/", ".")] = Matrix(item)

        def note(path: str, link: Any) -> None:
            if not isinstance(link, h5py.HardLink):
                refused[path.replace("/", ".")] = _LINK

        root.visititems(visit)
        root.visititems_links(note)
        yield Vectors(matrices, budget, refused)


def _is_plain(attributes: Any) -> bool:
    """Return True if a dataset contains values, not the references or sizes of an object."""
    kind = attributes.get("MATLAB_class", "double")
    kind = kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)
    return bool(_NUMBERS.fullmatch(kind)) and "MATLAB_empty" not in attributes
