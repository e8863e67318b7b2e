"""Data frames of any kind: columns of numbers out of them, and an array of the same kind back."""

import contextlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError

NAMES_SHOWN = 20


@dataclass(frozen=True)
class Frame:
    """A data frame of some library: columns as Arrow arrays by name, and how to wrap an answer."""

    names: Sequence[str]
    column: Callable[[str], Any]
    wrap: Callable[[pa.Array, str], Any]

    def numbers(self, names: Sequence[str], wanted_by: str) -> dict[str, FloatArray]:
        """Return columns as arrays of shape (rows,), NaN where null.

        Raises `InputError` for columns that are missing, repeated, infinite or not of numbers.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            more = len(self.names) - NAMES_SHOWN
            there = ", ".join(map(str, self.names[:NAMES_SHOWN])) or "no column"
            raise InputError(
                f"{wanted_by} needs {', '.join(names)}; the frame lacks {', '.join(missing)}. It "
                f"has {there}{f' and {more} more' if more > 0 else ''}."
            )
        found = {name: self._numbers(name) for name in names}
        rows = {name: len(values) for name, values in found.items()}
        if len(set(rows.values())) > 1:
            told = ", ".join(f"{name} {n:,}" for name, n in rows.items())
            raise InputError(f"the columns differ in length: {told}.")
        return found

    def _numbers(self, name: str) -> FloatArray:
        if list(self.names).count(name) > 1:
            raise InputError(f"the frame has several columns {name}.")
        try:
            column = self.column(name)
            if not _is_number(column.type):
                raise InputError(f"the column {name} is of {column.type}, not of numbers.")
            if column.type != pa.float64():
                column = column.cast(pa.float64())
            values = column.to_numpy(zero_copy_only=False)
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"the column {name} is no column of numbers: {error}") from None
        if infinite := int(np.isinf(values).sum()):
            raise InputError(f"the column {name} has {infinite:,} infinite values.")
        return np.asarray(values, dtype=np.float64)


def _is_number(kind: pa.DataType) -> bool:
    tests = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)
    return any(test(kind) for test in tests)


def open_frame(frame: Any) -> Frame:
    """Return a frame of Polars, pandas, Arrow (any stream) or a mapping. Raises `InputError`."""
    if _is_of("polars", "DataFrame", frame):
        return Frame(frame.columns, lambda name: frame[name].to_arrow(), _polars)
    if _is_of("pandas", "DataFrame", frame):
        return Frame(
            list(frame.columns),
            lambda name: pa.array(frame[name], from_pandas=True),
            lambda values, name: _pandas(values, name, frame.index),
        )
    if isinstance(frame, pa.RecordBatch):
        return Frame(frame.schema.names, frame.column, lambda values, _: values)
    if isinstance(frame, Mapping):
        return Frame(
            list(frame),
            lambda name: pa.array(frame[name], from_pandas=True),
            lambda values, _: values.to_numpy(zero_copy_only=False),
        )
    if hasattr(frame, "__arrow_c_stream__"):
        with contextlib.suppress(pa.ArrowException):  # of a series, not of a frame
            table = pa.table(frame)
            return Frame(
                table.column_names, table.column, lambda values, _: pa.chunked_array([values])
            )
    raise InputError(
        f"{type(frame).__name__} is no data frame. Give one of Polars (collected), pandas or "
        "Arrow, or a mapping of names to arrays."
    )


def _is_of(library: str, kind: str, frame: Any) -> bool:
    """Whether a value is of a class of a library, which need not be installed for that."""
    module = sys.modules.get(library)
    return module is not None and isinstance(frame, getattr(module, kind))


def _polars(values: pa.Array, name: str) -> Any:
    return sys.modules["polars"].Series(name, values)


def _pandas(values: pa.Array, name: str, index: Any) -> Any:
    numbers = values.to_numpy(zero_copy_only=False)
    return sys.modules["pandas"].Series(numbers, index=index, name=name, dtype="float64")
