"""A published model on a data frame: side-slip angles from columns in SI units.

Signals are rounded to counts, as in the sensors; values out of range are missing. Terms are added
from left to right, so that the result is bit for bit a dot product in SQL. Columns over time use
earlier rows of the same drive.
"""

import contextlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalog.counts import round_chunks, valid_values
from fleet_slip.catalog.definitions import round_number
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog
from fleet_slip.columns.drive_columns import ColumnPlan, DriveCounts
from fleet_slip.compiling import kernel
from fleet_slip.errors import DataError, InputError
from fleet_slip.grams.compute import counts_of
from fleet_slip.models.manifest import Manifest

# Estimates of a published model, sample by sample in the order of time, from logged counts.


@dataclass(frozen=True)
class Predictor:
    """A published model on counts: its columns, their coefficients and scales.

    `coefficients` are in rad per physical value, which is `scales` times the count.
    """

    plan: ColumnPlan
    intercept: float
    coefficients: tuple[float, ...]
    scales: tuple[float, ...]

    @classmethod
    def from_manifest(cls, signals: SignalCatalog, manifest: Manifest) -> "Predictor":
        """Return the predictor of a manifest, with the features as the manifest defines them.

        Raises `DataError` if these contradict each other, `RefusedError` if signals have other
        scales now.
        """
        manifest = manifest.estimate
        manifest.require_same_counts(signals)
        coefficients = tuple(term.coefficient for term in manifest.terms)
        scales = tuple(
            float(signals[term.signal].scale if term.logged else term.scale)
            for term in manifest.terms
        )
        plan = ColumnPlan.from_definitions(
            manifest.signals, manifest.features, manifest.definitions
        )
        return cls(plan, manifest.intercept, coefficients, scales)

    def __call__(self, drive: DriveCounts) -> FloatArray:
        """Return the estimate at each row in rad, shape (rows,); NaN where a column is missing.

        Raises `DataError` for a drive whose ticks columns over time cannot use.
        """
        coefficients, scales = np.array(self.coefficients), np.array(self.scales)
        estimate: FloatArray = np.full(len(drive.ticks), self.intercept)
        for rows, columns, _ in self.plan.blocks(drive):
            add_terms(columns, coefficients, scales, estimate[rows])
        return estimate


@kernel
def add_terms(columns: Any, coefficients: Any, scales: Any, estimate: Any) -> None:
    """Add a dot product's terms to the estimates, left to right; counts are (columns, rows)."""
    for number in range(len(columns)):
        column, coefficient, scale = columns[number], coefficients[number], scales[number]
        for row in range(len(estimate)):
            estimate[row] += coefficient * (column[row] * scale)


# Data frames of any kind: columns of numbers, and the result as an array of the same kind.

NAMES_SHOWN = 20


@dataclass(frozen=True)
class Frame:
    """A data frame of any library: Arrow arrays by name, and a function to wrap a result."""

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
            available = ", ".join(map(str, self.names[:NAMES_SHOWN])) or "no column"
            raise InputError(
                f"{wanted_by} needs {', '.join(names)}; the frame lacks {', '.join(missing)}. It "
                f"has {available}{f' and {more} more' if more > 0 else ''}."
            )
        columns = {name: self._numbers(name) for name in names}
        if len({len(values) for values in columns.values()}) > 1:
            lengths = ", ".join(f"{name} {len(values):,}" for name, values in columns.items())
            raise InputError(f"the columns differ in length: {lengths}.")
        return columns

    def _numbers(self, name: str) -> FloatArray:
        if list(self.names).count(name) > 1:
            raise InputError(f"the frame has several columns {name}.")
        try:
            column = self.column(name)
            if not any(is_number(column.type) for is_number in _NUMBERS):
                raise InputError(f"the column {name} is {column.type}, not numeric.")
            values = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"the column {name} is not numeric: {error}") from None
        if infinite := int(np.isinf(values).sum()):
            raise InputError(f"the column {name} has {infinite:,} infinite values.")
        return np.asarray(values, dtype=np.float64)


_NUMBERS = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)


def _array_of(values: Any) -> pa.Array:
    """Return an Arrow array; texts of joined pandas frames become one chunk."""
    column = pa.array(values, from_pandas=True)
    return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column


def open_frame(frame: Any) -> Frame:
    """Return a frame of Polars, pandas, Arrow (any stream) or a mapping. Raises `InputError`."""
    polars, pandas = sys.modules.get("polars"), sys.modules.get("pandas")
    if polars and isinstance(frame, polars.DataFrame):
        return Frame(
            frame.columns,
            lambda name: frame[name].to_arrow(),
            lambda values, name: polars.Series(name, values),
        )
    if pandas and isinstance(frame, pandas.DataFrame):
        return Frame(
            list(frame.columns),
            lambda name: _array_of(frame[name]),
            lambda values, name: pandas.Series(
                values.to_numpy(zero_copy_only=False), frame.index, "float64", name
            ),
        )
    if isinstance(frame, pa.RecordBatch):
        return Frame(frame.schema.names, frame.column, lambda values, _: values)
    if isinstance(frame, Mapping):
        return Frame(
            list(frame),
            lambda name: _array_of(frame[name]),
            lambda values, _: values.to_numpy(zero_copy_only=False),
        )
    if hasattr(frame, "__arrow_c_stream__"):
        with contextlib.suppress(pa.ArrowException):  # the stream of a series
            table = pa.table(frame)
            return Frame(
                table.column_names,
                lambda name: table.column(name).combine_chunks(),
                lambda values, _: pa.chunked_array([values]),
            )
    raise InputError(
        f"{type(frame).__name__} is no data frame. Give one of Polars (collected), pandas or "
        "Arrow, or a mapping of names to arrays."
    )


def predict(
    signals: SignalCatalog, manifest: Manifest, frame: Any, predictor: Predictor | None = None
) -> Any:
    """Return the angle of each row in rad; see `ModelVersion.predict`."""
    predictor = predictor or Predictor.from_manifest(signals, manifest)
    opened, plan = open_frame(frame), predictor.plan
    if not plan.signals:
        raise DataError(f"the columns of {manifest.name} use no signal. Publish it again.")
    columns = opened.numbers(manifest.estimate.columns(signals), f"the model {manifest.name}")
    counts = {
        name: round_chunks(
            [valid_values(columns[signals[name].column], signals[name])], signals[name]
        )
        for name in plan.signals
    }
    calibrated: dict[str, Fraction] = {
        definition.number.name: Fraction(definition.number.grain)
        for definition in manifest.estimate.definitions.values()
        if definition.number
    }
    if missing := [name for name in (*plan.facts, *calibrated) if name not in opened.names]:
        raise InputError(
            f"{manifest.name} needs properties of the car: {', '.join(missing)}. Calibrated ones: "
            "fleet-slip calibrate --car NAME. A car that has driven too little has nulls there."
        )
    facts = {name: opened.column(name) for name in plan.facts}
    numbers = opened.numbers([*calibrated], manifest.name)
    rows = len(next(iter(counts.values())))
    ticks, drives = np.arange(rows), [np.arange(rows)]
    if plan.windows:
        ticks = _ticks(opened, rows)
        drives = _rows_of_each_drive(opened, rows)
    drive = counts_of(pa.table({"tick": ticks, **counts}), plan, {})
    angle = np.empty(rows)
    for at in drives if rows else ():
        parameters = {
            name: count
            for name, grain in calibrated.items()
            if np.isfinite(value := numbers[name][at[0]])
            and (count := round_number(Fraction(float(value)), grain)) is not None
        }
        attributes = {name: values[at[0]].as_py() for name, values in facts.items()}
        angle[at] = predictor(drive.segment(at, attributes, parameters))
    return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)


def _rows_of_each_drive(frame: Frame, rows: int) -> list[IntArray]:
    """Return the numbers of the rows of each drive."""
    if "drive_id" not in frame.names:
        return [np.arange(rows)]
    indices = pc.fill_null(frame.column("drive_id").dictionary_encode().indices, -1)
    _, drives, sizes = np.unique(indices, return_inverse=True, return_counts=True)
    return np.split(np.argsort(drives, kind="stable"), np.cumsum(sizes)[:-1])


def _ticks(frame: Frame, rows: int) -> IntArray:
    """Return the tick of each row: by `tick` or `time_s`, else one row is one tick."""
    for name, per_tick in (("tick", 1), ("time_s", int(1 / SAMPLE_TIME_S))):
        if name in frame.names:
            values = frame.numbers([name], "a model that looks back")[name]
            if np.isnan(values).any():
                raise InputError(f"the column {name} has missing values.")
            return np.rint(values * per_tick).astype(np.int64)
    return np.arange(rows)
