"""Reads MATLAB files: version 5 to 7 through scipy, 7.3 (HDF5) through h5py, some rows at once.

A column is the path of a vector, `Data.Vehicle.yawRate`, also in an array of structs,
`rec.Y(2).Data`, or one column of a matrix, `wheels(:,2)`, or row, `wheels(2,:)`.
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
    MAX_COLUMNS,
    Budget,
    Channel,
    Source,
    as_column,
    load_library,
    missing_column,
)

_COLUMN = re.compile(r"(.+)\((?::,(\d+)|(\d+),:)\)")
_MAX_COLUMNS = 64
_NUMBERS = re.compile(r"u?int(8|16|32|64)|double|single|logical")
_PACKED = {"scale_factor", "add_offset"}
"""Attributes of netCDF for integers that encode physical values."""
_LINK = "is a link, which is not followed. Map what it links to."
_OBJECT = (
    "is a {} of MATLAB, whose values are not in the file as numbers. Save it as a struct, such as "
    "a timetable TT by: S = table2struct(timetable2table(TT), 'ToScalar', true)"
)
_COUNTS = (
    f"has counts, with {' and '.join(sorted(_PACKED))} of netCDF, which are not applied. Export it "
    "again with physical values."
)
WINDOW_ROWS = 2**15
"""Rows that are read at once."""

Array = np.ndarray[Any, Any]


class Matrix:
    """An array of HDF5, with the axes of MATLAB reversed. Axes of length 1 are ignored.

    Of a matrix with more columns than a table has, such as 4 x n, the rows are the signals.
    """

    def __init__(self, values: Any, title: str = "", unit: str = "") -> None:
        """Take an array of numpy or a dataset of h5py, and its name and unit if the file has them.

        Neither MATLAB nor HDF5 has units, but structs of recorders do.
        """
        self._values, self.title, self.unit = values, title, unit
        self.shape = tuple(size for size in reversed(values.shape) if size != 1)

    @property
    def is_wide(self) -> bool:
        """True if the signals are the rows."""
        return len(self.shape) == 2 and self.shape[1] > _MAX_COLUMNS >= self.shape[0]

    @property
    def size(self) -> tuple[int, int]:
        """Values of a signal, and signals. Arrays with more axes are no signals."""
        if len(self.shape) == 1:
            return self.shape[0], 1
        if len(self.shape) != 2:
            return 0, 0
        return (self.shape[1], self.shape[0]) if self.is_wide else (self.shape[0], self.shape[1])

    def names(self, path: str) -> list[str]:
        """Return the names of the signals."""
        _, signals = self.size
        if signals == 1:
            return [path]
        places = "({},:)" if self.is_wide else "(:,{})"
        return [path + places.format(number) for number in range(1, signals + 1)]

    def read(self, signal: int, start: int, end: int) -> Array:
        """Return some values of a signal."""
        places = [slice(start, end), signal] if self.is_wide else [signal, slice(start, end)]
        indices = iter(places[-len(self.shape) :])
        place = tuple(0 if size == 1 else next(indices) for size in self._values.shape)
        return np.asarray(self._values[place])


class Vectors(Source):
    """The vectors of an open file. Time is one of them."""

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
            if rows > 1 and columns <= _MAX_COLUMNS:
                channels += [
                    Channel(name, matrix.unit, f"{rows} rows", matrix.title)
                    for name in matrix.names(path)
                ]
        return channels

    def unreadable(self) -> list[str]:
        """Return why parts of the file are not read."""
        return [f"{path!r} {why}" for path, why in self._refused.items()]

    def find(self, column: str) -> tuple[str, tuple[Matrix, int]]:
        """Return a matrix, and which of its columns is meant. Raises `InputError`."""
        matrix_of_name = self._matrices.get(column)
        if matrix_of_name is not None:
            if matrix_of_name.size[1] != 1:
                axes = " x ".join(map(str, matrix_of_name.shape)) or "1"
                raise InputError(
                    f"{quote_name(self._file)}: channel {column!r} has {axes} values, not one a "
                    f"row. Map one of its signals, such as {matrix_of_name.names(column)[:1]}."
                )
            return "", (matrix_of_name, 0)
        match = _COLUMN.fullmatch(column)
        matrix = self._matrices.get(match[1]) if match else None
        if match and matrix and column in matrix.names(match[1]):
            return "", (matrix, int(match[2] or match[3]) - 1)
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
    if "__function_workspace__" in content:
        variables["None"] = None
    matrices, refused = dict[str, Matrix](), dict[str, str]()
    _add_arrays(variables, "", matrices, refused)
    yield Vectors(matrices, budget, refused)


def _add_arrays(
    variables: Mapping[str, Any],
    above: str,
    matrices: dict[str, Matrix],
    refused: dict[str, str],
) -> None:
    """Add the matrices of numbers or text in a struct, by path, and the objects in it."""
    texts = {str(key).lower(): value for key, value in variables.items() if isinstance(value, str)}
    title, unit = texts.get("name", ""), texts.get("unit", texts.get("units", ""))
    for name, value in variables.items():
        path = f"{above}{name}"
        if isinstance(value, dict):
            _add_arrays(value, f"{path}.", matrices, refused)
        elif isinstance(value, np.ndarray) and value.ndim and value.dtype.kind in "iufbU":
            matrices[path] = Matrix(value.T, title, unit)
        elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype.kind == "O"):
            structs = [item for item in np.ravel(value) if isinstance(item, dict)]
            for number, item in enumerate(structs, 1):
                _add_arrays(item, f"{path}({number}).", matrices, refused)
        elif type(value).__name__ == "MatlabOpaque" or name == "None":
            refused[path] = _OBJECT.format("object")


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
            if not isinstance(item, h5py.Dataset) or path.startswith("#"):
                return
            require_inside(path, item)
            name, kind = path.replace("/", "."), _matlab_class(item.attrs)
            if _PACKED & set(item.attrs):
                refused[name] = _COUNTS
            elif h5py.check_ref_dtype(item.dtype) is h5py.Reference:
                add_elements(path, item, is_cell=kind == "cell")
            elif "MATLAB_object_decode" in item.attrs or kind in _OBJECTS:
                refused[name] = _OBJECT.format(kind)
            elif item.shape and item.dtype.kind in "iufb" and _is_plain(item.attrs):
                matrices[name] = Matrix(item)

        def require_inside(path: str, item: Any) -> None:
            layout = item.id.get_create_plist()
            if layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
                raise InputError(
                    f"{quote_name(file)}: the values of {path!r} are in other files. Export it "
                    "again with all values in one file."
                )

        def add_elements(path: str, item: Any, *, is_cell: bool) -> None:
            """Add the elements of a cell, or a field of an array of structs."""
            above, _, field = path.replace("/", ".").rpartition(".")
            for number, reference in enumerate(item[()].ravel()[:MAX_COLUMNS], 1):
                element = root[reference] if reference else None
                if not isinstance(element, h5py.Dataset):
                    continue
                name = f"{above}({number}).{field}"
                if is_cell:
                    name = f"{path.replace('/', '.')}{{{number}}}"
                require_inside(name, element)
                if element.shape and element.dtype.kind in "iufb" and _is_plain(element.attrs):
                    matrices[name] = Matrix(element)

        def note(path: str, link: Any) -> None:
            if not isinstance(link, h5py.HardLink):
                refused[path.replace("/", ".")] = _LINK

        root.visititems(visit)
        root.visititems_links(note)
        yield Vectors(matrices, budget, refused)


_OBJECTS = {"table", "timetable", "timeseries", "datetime", "duration", "categorical", "string"}


def _matlab_class(attributes: Any) -> str:
    kind = attributes.get("MATLAB_class", "double")
    return kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)


def _is_plain(attributes: Any) -> bool:
    """Return True if a dataset contains values, not the references or sizes of an object."""
    return bool(_NUMBERS.fullmatch(_matlab_class(attributes))) and "MATLAB_empty" not in attributes
