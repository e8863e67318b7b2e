"""Reads MATLAB files, version 5, and 7.3 (HDF5) through h5py, some rows at once.

A column is the path of a vector, `Data.Vehicle.yawRate`, or one column of a matrix, `wheels(:,2)`.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import Channel, as_column, describe_missing, reading_with
from fleet_slip.ingest.formats.matlab_elements import open_matrices
from fleet_slip.words import shown

_COLUMN = re.compile(r"(.+)\(:,(\d+)\)")
_MOST_COLUMNS = 64
_NUMBERS = re.compile(r"u?int(8|16|32|64)|double|single|logical")
_PACKED = {"scale_factor", "add_offset"}
"""What netCDF says of counts in a dataset."""
WINDOW_ROWS = 2**15
"""Rows that are read at once."""
Array = np.ndarray[Any, Any]


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
