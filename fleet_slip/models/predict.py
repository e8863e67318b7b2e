"""A published model on a data frame: side-slip angles from columns in SI units.

The angle is `intercept + sum(coefficient * signal)`, added up from left to right as `score` does in
SQL, so that both give the same bits. A feature is a function of counts: the signals that it is
made of are rounded to counts as the sensors round them, and its SQL is run as it stands in the
manifest. A model with columns over time looks back within a drive: by `drive_id` and `tick` or
`time_s` of the frame; a frame without them is one drive with a row for each tick.
"""

from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.car_numbers import round_number
from fleet_slip.catalogue.column_sql import with_features
from fleet_slip.catalogue.counts import round_to_counts
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.errors import DataError, InputError
from fleet_slip.grams.drive_rows import counts_of
from fleet_slip.models.frames import Frame, open_frame
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predictor import Predictor
from fleet_slip.warehouse.database import database_errors, open_database


def predict(manifest: Manifest, frame: Any) -> Any:
    """Return the angle in rad for each row of a frame; see `ModelVersion.predict`."""
    opened = open_frame(frame)
    columns = opened.numbers(manifest.columns, f"the model {manifest.name}")
    if manifest.definitions:
        angle = _over_time(manifest, opened, columns)
        return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)
    physical = columns | _features(manifest, columns)
    angle = np.asarray(manifest.intercept)
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float64 is infinite, or NaN
        for term in manifest.terms:
            angle = angle + term.coefficient * physical[term.column]
    return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)


def _over_time(manifest: Manifest, frame: Frame, columns: dict[str, FloatArray]) -> FloatArray:
    """Return the angles of a model that looks back: of each drive by itself, in the order of time.

    Raises `DataError` if time does not rise within a drive, and `InputError` for a fact that the
    frame lacks.
    """
    predictor = Predictor.of(manifest)
    signals = catalogue()
    counts = {
        name: round_to_counts(columns[signals[name].column], signals[name])
        for name in predictor.plan.signals
    }
    if missing := [name for name in predictor.plan.facts if name not in frame.names]:
        raise InputError(f"{manifest.name} needs what the car knows: {', '.join(missing)}.")
    facts = {name: _column(frame, name) for name in predictor.plan.facts}
    numbers = _numbers(manifest, frame)
    ticks, drives = _ticks(frame, len(next(iter(counts.values())))), _drives(frame)
    rows = pa.table({"tick": ticks, **counts, **facts})
    if not len(rows):
        return np.empty(0)
    angle = np.full(len(rows), np.nan)
    each = [np.arange(len(rows))] if drives is None else _rows_of_each(drives)
    for at in each:
        own = {
            name: round_number(Fraction(float(values[at[0]])), grain)
            for name, (values, grain) in numbers.items()
            if not np.isnan(values[at[0]])
        }
        angle[at] = predictor(counts_of(rows.take(at), predictor.plan, None, own))
    return angle


def _rows_of_each(drives: IntArray) -> list[IntArray]:
    return [np.flatnonzero(drives == drive) for drive in np.unique(drives)]


def _numbers(manifest: Manifest, frame: Frame) -> dict[str, tuple[FloatArray, Fraction]]:
    """Return what a car's drives tell of it, in SI units by row, NaN where they do not, and grains.

    Raises `InputError` if the frame lacks a column of the number's name.
    """
    used = {one.number.name: one.number for one in manifest.definitions.values() if one.number}
    if missing := [name for name in used if name not in frame.names]:
        raise InputError(
            f"{manifest.name} needs what a car's own drives tell of it: {', '.join(missing)}. Run: "
            "fleet-slip calibrate --car NAME. A car that has driven too little has nulls there."
        )
    return {
        name: (frame.numbers([name], manifest.name)[name], Fraction(number.grain))
        for name, number in used.items()
    }


def _column(frame: Frame, name: str) -> pa.Array:
    column = frame.column(name)
    return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column


def _ticks(frame: Frame, rows: int) -> IntArray:
    """Return the tick of each row: by `tick` or `time_s`, else one row is one tick."""
    for name, per_tick in (("tick", 1), ("time_s", int(1 / SAMPLE_TIME_S))):
        if name in frame.names:
            values = frame.numbers([name], "a model that looks back")[name]
            if np.isnan(values).any():
                raise InputError(f"the column {name} has missing values.")
            return np.rint(values * per_tick).astype(np.int64)
    return np.arange(rows)


def _drives(frame: Frame) -> IntArray | None:
    """Return a number for each row's drive; None if the frame is of one."""
    if "drive_id" not in frame.names:
        return None
    ids = _column(frame, "drive_id")
    if not pa.types.is_dictionary(ids.type):
        ids = ids.dictionary_encode()
    numbers: IntArray = ids.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    return numbers


def _features(manifest: Manifest, columns: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Return the features in SI units by column, NaN where one has no value."""
    terms = [term for term in manifest.terms if term.sql]
    if not terms:
        return {}
    signals = catalogue()
    used = {name for term in terms for name in term.inputs}
    if not used:
        raise DataError(f"the features of {manifest.name} are of no signal. Publish it again.")
    counts = {name: round_to_counts(columns[signals[name].column], signals[name]) for name in used}
    with open_database() as database, database_errors(f"the features of {manifest.name}"):
        database.register("counts", pa.table(counts))
        rows = with_features("counts", manifest.features)
        names = ", ".join(manifest.features)
        found = database.sql(f"SELECT {names} FROM {rows}").to_arrow_table()
    return {
        term.column: found[term.signal].cast(pa.float64()).to_numpy() * float(term.scale)
        for term in terms
    }
