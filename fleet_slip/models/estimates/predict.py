"""A published model on a data frame: side-slip angles from columns in SI units.

Terms are added from left to right, to the bits of `score` in SQL. Features are arithmetic of
rounded counts, as the manifest has it; what is out of its valid range is missing. Models with
columns over time look back within a drive.
"""

from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.car_numbers import round_number
from fleet_slip.catalogue.counts import round_to_counts, valid_values
from fleet_slip.catalogue.definitions import plain_column
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.columns.row_counts import row_counts
from fleet_slip.errors import DataError, InputError
from fleet_slip.grams.rows.drive_rows import counts_of
from fleet_slip.models.estimates.data_frames import Frame, open_frame
from fleet_slip.models.estimates.predictor import Predictor
from fleet_slip.models.manifest import Manifest


def predict(manifest: Manifest, frame: Any, predictor: Predictor | None = None) -> Any:
    """Return the angle of each row in rad; see `ModelVersion.predict`."""
    opened = open_frame(frame)
    columns = opened.numbers(manifest.columns, f"the model {manifest.name}")
    for signal in catalogue().signals.values():
        if signal.column in columns:
            columns[signal.column] = valid_values(columns[signal.column], signal)
    if manifest.definitions:
        angle = _over_time(manifest, opened, columns, predictor or Predictor.of(manifest))
        return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)
    physical = columns | _features(manifest, columns)
    angle = np.asarray(manifest.intercept)
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float64 is infinite, or NaN
        for term in manifest.terms:
            angle = angle + term.coefficient * physical[term.column]
    return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)


def _over_time(
    manifest: Manifest, frame: Frame, columns: dict[str, FloatArray], predictor: Predictor
) -> FloatArray:
    """Return the angles of a model that looks back, drive by drive in the order of time."""
    signals = catalogue()
    counts = {
        name: round_to_counts(columns[signals[name].column], signals[name])
        for name in predictor.plan.signals
    }
    if missing := [name for name in predictor.plan.facts if name not in frame.names]:
        raise InputError(f"{manifest.name} needs what the car knows: {', '.join(missing)}.")
    facts = {name: _column(frame, name) for name in predictor.plan.facts}
    numbers = _numbers(manifest, frame)
    ticks = _ticks(frame, len(next(iter(counts.values()))))
    if not len(ticks):
        return np.empty(0)
    rows = counts_of(pa.table({"tick": ticks, **counts}), predictor.plan, {})
    angle = np.empty(len(ticks))
    with predictor.lend_workspace() as workspace:
        for at in _rows_of_each_drive(frame, len(ticks)):
            first = at.start if isinstance(at, slice) else at[0]
            own = {
                name: count
                for name, (values, grain) in numbers.items()
                if np.isfinite(values[first])
                and (count := round_number(Fraction(float(values[first])), grain)) is not None
            }
            known = {name: values[first].as_py() for name, values in facts.items()}
            angle[at] = predictor(rows.part(at, known, own), workspace)
    return angle


def _rows_of_each_drive(frame: Frame, rows: int) -> list[slice] | list[IntArray]:
    """Return the rows of each drive: a slice of each, if the rows of every drive lie together."""
    if "drive_id" not in frame.names:
        return [slice(0, rows)]
    runs = pc.run_end_encode(_column(frame, "drive_id").cast(pa.large_string()))
    ends = [0, *runs.run_ends.to_pylist()]
    drives = runs.values.dictionary_encode().indices.fill_null(-1).to_numpy(zero_copy_only=False)
    found = np.unique(drives)
    if len(found) == len(drives):
        return [slice(*one) for one in pairwise(ends)]
    of_row = np.repeat(drives, np.diff(ends))
    return [np.flatnonzero(of_row == drive) for drive in found]


def _numbers(manifest: Manifest, frame: Frame) -> dict[str, tuple[FloatArray, Fraction]]:
    """Return what a car's drives tell of it, in SI units by row with NaN, and grains."""
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


def _features(manifest: Manifest, columns: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Return the features in SI units by column, NaN where one has no value."""
    terms = [term for term in manifest.terms if term.sql]
    made = [(term, plain_column(term.signal, term.sql)) for term in terms]
    if not all(one.signals for _, one in made):
        raise DataError(f"the features of {manifest.name} are of no signal. Publish it again.")
    signals = catalogue()
    counts, present = {}, {}
    for name in {name for _, one in made for name in one.signals}:
        rounded = round_to_counts(columns[signals[name].column], signals[name])
        present[name] = rounded.is_valid().to_numpy(zero_copy_only=False)
        counts[name] = rounded.fill_null(0).to_numpy().astype(np.int64)
    found = {}
    for term, one in made:
        given = np.logical_and.reduce([present[name] for name in one.signals])
        values, there = row_counts(one, counts, given)
        found[term.column] = np.where(there, values * float(term.scale), np.nan)
    return found
