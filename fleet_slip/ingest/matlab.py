"""Reads MATLAB files, version 5 through scipy and 7.3 (HDF5) through h5py.

A column is the path of a vector, `Data.Vehicle.yawRate`, or one column of a matrix, `wheels(:,2)`.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import describe_missing, shown
from fleet_slip.ingest.matlab_check import require_sound_tags
from fleet_slip.ingest.source import Channel, as_column, reading_with

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
HDF5_AT = 512
"""Where a 7.3 file becomes HDF5: MATLAB's own header is before it."""
MAT5_MAGIC = b"MATLAB 5.0 MAT-file"

_COLUMN = re.compile(r"(.+)\(:,(\d+)\)")
_MOST_COLUMNS = 64
Array = np.ndarray[Any, Any]


class MatSource:
    """The vectors of an open MATLAB file. Time is one of them."""

    has_clock = False

    def __init__(self, file: Path, vectors: Mapping[str, Any]) -> None:
        """Take the file's path, and an array, or what becomes one, for each path."""
        self._file, self._vectors = file, vectors

    def channels(self) -> list[Channel]:
        """Return all vectors, and the columns of matrices."""
        found = []
        for path, vector in self._vectors.items():
            rows, columns = _rows_columns(vector.shape)
            names = [path] if columns == 1 else [f"{path}(:,{i + 1})" for i in range(columns)]
            if rows > 1 and columns <= _MOST_COLUMNS:
                found += [Channel(name, "", f"{rows} rows") for name in names]
        return found

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield all rows at once. Raises `InputError` if columns differ in length."""
        found = [as_column(self._file, name, self._column(name)) for name in columns]
        for column in found:
            if len(column) != len(found[0]):
                raise InputError(
                    f"{shown(self._file)}: {column.name!r} has {len(column):,} values and "
                    f"{found[0].name!r} has {len(found[0]):,}. Give the signal the time that goes "
                    'with it: time = "…".'
                )
        yield pl.DataFrame(found)

    def _column(self, name: str) -> Array:
        whole = self._vectors.get(name)
        if whole is not None:
            values: Array = np.asarray(whole)
            return values.ravel() if 1 in values.shape or not values.size else values
        found = _COLUMN.fullmatch(name)
        matrix = self._vectors.get(found[1]) if found else None
        if found is None or matrix is None or not 1 <= int(found[2]) <= matrix.shape[-1]:
            names = [channel.name for channel in self.channels()]
            raise InputError(f"{shown(self._file)}: {describe_missing(name, names)}")
        return np.asarray(matrix)[:, int(found[2]) - 1]


class _Dataset:
    """A dataset of HDF5, which has the axes of MATLAB in reverse, read when it is asked for."""

    def __init__(self, dataset: Any) -> None:
        self._dataset, self.shape = dataset, tuple(reversed(dataset.shape))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        values: Array = np.asarray(self._dataset[()]).T
        return values if dtype is None else values.astype(dtype)


def _rows_columns(shape: Sequence[int]) -> tuple[int, int]:
    if len(shape) == 1:
        return shape[0], 1
    if len(shape) != 2:
        return 0, 0
    return (max(shape), 1) if 1 in shape else (shape[0], shape[1])


@contextmanager
def open_mat(file: Path) -> Iterator[MatSource]:
    """Open a MATLAB file of version 4 to 7. Raises `InputError`."""
    require_sound_tags(file)
    with reading_with(file, "scipy.io") as scipy_io:
        content = scipy_io.loadmat(file, simplify_cells=True)
    vectors: dict[str, Array] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _flatten(name, value, vectors)
    yield MatSource(file, vectors)


def _flatten(path: str, value: Any, vectors: dict[str, Array]) -> None:
    if isinstance(value, dict):
        for name, part in value.items():
            _flatten(f"{path}.{name}", part, vectors)
    elif isinstance(value, np.ndarray) and value.ndim and value.dtype.kind in "iufbUS":
        vectors[path] = value


@contextmanager
def open_mat73(file: Path) -> Iterator[MatSource]:
    """Open a MATLAB file of version 7.3, or any HDF5 file. Raises `InputError`."""
    with reading_with(file, "h5py") as h5py, h5py.File(file, "r") as root:
        vectors: dict[str, _Dataset] = {}

        def visit(path: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not path.startswith("#refs#"):
                kind = item.attrs.get("MATLAB_class", b"")
                if item.shape and item.dtype.kind in "iufb" and kind != b"char":
                    vectors[path.replace("/", ".")] = _Dataset(item)

        root.visititems(visit)
        yield MatSource(file, vectors)
