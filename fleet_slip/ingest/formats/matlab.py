"""Reads MATLAB files: version 5 to 7 through scipy, 7.3 (HDF5) through h5py, some rows at once.

A column is the path of a vector, `Data.Vehicle.yawRate`, also in an array of structs,
`rec.Y(2).Data`, or one column of a matrix, `wheels(:,2)`, or row, `wheels(2,:)`.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import (
    MAX_COLUMNS,
    OWN_TIME,
    Budget,
    Channel,
    Source,
    as_column,
    load_library,
    missing_column,
)

_MAX_SIGNALS = 64
"""Signals of a matrix. One with more columns, such as 4 x n, has its signals in its rows."""
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
WINDOW_ROWS = 2**17
"""Rows of a batch: for each batch npTDMS reads all values of a channel in a segment."""


@dataclass(frozen=True)
class Vector:
    """The values of a signal.

    Neither MATLAB nor HDF5 has titles and units, but structs of recorders do. A waveform has times:
    of its first value in s, and the step to each next one.
    """

    rows: int
    read: Callable[[slice], Any]
    title: str = ""
    unit: str = ""
    times: tuple[float, float] | None = None

    @property
    def base(self) -> str:
        """Identifies the times of a waveform."""
        return f"{self.rows} times {self.times}" if self.times else ""


class Vectors(Source):
    """The vectors of an open file. Time is one of them, except of waveforms."""

    def __init__(self, budget: Budget) -> None:
        """Begin without vectors and without refused ones; both are by name."""
        self._budget = budget
        self.vectors: dict[str, Vector] = {}
        self.refused: dict[str, str] = {}

    def add_array(self, path: str, values: Any, title: str = "", unit: str = "") -> None:
        """Add the signals of an array of HDF5, with the axes of MATLAB reversed."""
        axes = [axis for axis, size in enumerate(values.shape) if size != 1]
        sizes = [values.shape[axis] for axis in axes]
        if len(axes) == 1 and sizes[0]:
            read = partial(_take, values, {}, axes[0])
            self.vectors[path] = Vector(sizes[0], read, title, unit)
        elif len(axes) == 2 and 0 < min(sizes) <= _MAX_SIGNALS:
            is_wide = sizes[0] > _MAX_SIGNALS
            long, across = (0, 1) if is_wide else (1, 0)
            for number in range(sizes[across]):
                name = f"{path}({number + 1},:)" if is_wide else f"{path}(:,{number + 1})"
                read = partial(_take, values, {axes[across]: number}, axes[long])
                self.vectors[name] = Vector(sizes[long], read, title, unit)
        elif math.prod(values.shape) > 1:
            shape = " x ".join(map(str, reversed(values.shape)))
            self.refused[path] = f"has {shape} values, not one a row. Save its signals as vectors."

    def add_struct(self, variables: Mapping[str, Any], above: str = "") -> None:
        """Add the arrays of numbers or text in a struct, by path, and the objects in it."""
        texts = {str(key).lower(): text for key, text in variables.items() if type(text) is str}
        title, unit = texts.get("name", ""), texts.get("unit", texts.get("units", ""))
        for name, value in variables.items():
            path = f"{above}{name}"
            if isinstance(value, dict):
                self.add_struct(value, f"{path}.")
            elif isinstance(value, np.ndarray) and value.ndim and value.dtype.kind in "iufbU":
                self.add_array(path, value.T, title, unit)
            elif isinstance(value, list) or getattr(value, "dtype", None) == np.object_:
                structs = [item for item in np.ravel(value) if isinstance(item, dict)]
                for number, item in enumerate(structs, 1):
                    self.add_struct(item, f"{path}({number}).")
            elif type(value).__name__ == "MatlabOpaque" or name == "None":
                self.refused[path] = _OBJECT.format("object")

    def channels(self) -> list[Channel]:
        """Return all vectors."""
        return [
            Channel(name, vector.unit, vector.base or f"{vector.rows} rows", vector.title)
            for name, vector in self.vectors.items()
        ]

    def unreadable(self) -> list[str]:
        """Return why parts of the file are not read."""
        return [f"{path!r} {why}" for path, why in self.refused.items()]

    def find(self, column: str) -> tuple[str, Vector]:
        """Return the time base of a vector, and the vector. Raises `InputError`."""
        if column in self.vectors:
            return self.vectors[column].base, self.vectors[column]
        for path, why in self.refused.items():
            if f"{column}.".startswith(f"{path}."):
                raise self._budget.error(f"{column!r} {why}")
        raise missing_column(self._budget.file, column, [*self.vectors])

    def read(self, _base: str, vectors: dict[str, Vector]) -> Iterator[pl.DataFrame]:
        """Yield all rows, some at once. Raises `InputError` if columns differ in length."""
        first, vector = next(iter(vectors.items()))
        for name, other in vectors.items():
            if other.rows != vector.rows:
                raise self._budget.error(
                    f"{name!r} has {other.rows:,} values and {first!r} has {vector.rows:,}. Give "
                    'the signal the time that goes with it: time = "…".'
                )
        for start in range(0, max(vector.rows, 1), WINDOW_ROWS):
            window = slice(start, min(start + WINDOW_ROWS, vector.rows))
            columns = {
                name: as_column(self._budget.file, name, np.asarray(other.read(window)))
                for name, other in vectors.items()
            }
            if vector.times:
                start_s, step_s = vector.times
                columns[OWN_TIME] = pl.Series(start_s + step_s * np.arange(start, window.stop))
            yield pl.DataFrame(columns)


def _take(values: Any, fixed: Mapping[int, int], axis: int, rows: slice) -> Any:
    return values[tuple(rows if n == axis else fixed.get(n, 0) for n in range(values.ndim))]


@contextmanager
def open_mat(budget: Budget, _formats: FileFormats) -> Iterator[Vectors]:
    """Open a MATLAB file. Raises `InputError`. One of version 5 to 7 is then in memory."""
    with budget.file.open("rb") as stream:
        if not stream.read(10).startswith(b"MATLAB 5.0"):
            with _open_hdf5(budget) as vectors:
                yield vectors
            return
        stream.seek(0)
        file = load_library(budget.file, "scipy.io").loadmat(stream, simplify_cells=True)
    variables = {name: value for name, value in file.items() if not name.startswith("__")}
    if "__function_workspace__" in file:
        variables["None"] = None
    vectors = Vectors(budget)
    vectors.add_struct(variables)
    yield vectors


@contextmanager
def _open_hdf5(budget: Budget) -> Iterator[Vectors]:
    """Open a MATLAB file of version 7.3, or any HDF5 file. Raises `InputError`.

    A dataset of HDF5 can refer to values in any other file. This is tested first for each dataset:
    the library opens those files even for the size. Links are not followed.
    """
    h5py = load_library(budget.file, "h5py")
    content = Vectors(budget)

    def add(name: str, item: Any) -> None:
        """Add a dataset, or those that it refers to: elements of a cell, or fields of structs."""
        if not isinstance(item, h5py.Dataset):
            return
        layout = item.id.get_create_plist()
        if layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
            raise budget.error(
                f"the values of {name!r} are in other files. Export it again with all in one file."
            )
        kind = item.attrs.get("MATLAB_class", b"double")
        kind = kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)
        if _PACKED & set(item.attrs):
            content.refused[name] = _COUNTS
        elif h5py.check_ref_dtype(item.dtype) is h5py.Reference:
            above, _, field = name.rpartition(".")
            pattern = f"{name}{{{{{{}}}}}}" if kind == "cell" else f"{above}({{}}).{field}"
            for number, reference in enumerate(item[()].ravel()[:MAX_COLUMNS], 1):
                if reference:
                    add(pattern.format(number), root[reference])
        elif "MATLAB_object_decode" in item.attrs or kind in _OBJECTS:
            content.refused[name] = _OBJECT.format(kind)
        elif "MATLAB_empty" in item.attrs or not _NUMBERS.fullmatch(kind):
            return
        elif item.shape and item.dtype.kind in "iufb":
            content.add_array(name, item)

    def visit(path: str, item: Any) -> None:
        if not path.startswith("#"):  # where MATLAB keeps what references lead to
            add(path.replace("/", "."), item)

    def note_link(path: str, link: Any) -> None:
        if not isinstance(link, h5py.HardLink):
            content.refused[path.replace("/", ".")] = _LINK

    with h5py.File(budget.file, "r") as root:
        root.visititems(visit)
        root.visititems_links(note_link)
        yield content


_OBJECTS = {"table", "timetable", "timeseries", "datetime", "duration", "categorical", "string"}
