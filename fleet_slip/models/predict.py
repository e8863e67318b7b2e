"""A published model on a data frame: side-slip angles from columns in SI units.

The angle is `intercept + sum(coefficient * signal)`, added up from left to right as `score` does in
SQL, so that both give the same bits. A feature is a function of counts: the signals that it is
made of are rounded to counts as the sensors round them, and its SQL is run as it stands in the
manifest. A model with columns over time takes the rows for the ticks of one drive, in their order.
"""

from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.columns import with_features
from fleet_slip.catalogue.counts import round_to_counts
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.drive_rows import counts_of
from fleet_slip.models.frames import open_frame
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predictor import Predictor
from fleet_slip.warehouse.database import database_errors, open_database


def predict(manifest: Manifest, frame: Any) -> Any:
    """Return the angle in rad for each row of a frame; see `ModelVersion.predict`."""
    opened = open_frame(frame)
    columns = opened.numbers(manifest.columns, f"the model {manifest.name}")
    if manifest.definitions:
        angle = _over_time(manifest, columns)
        return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)
    physical = columns | _features(manifest, columns)
    angle = np.asarray(manifest.intercept)
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float64 is infinite, or NaN
        for term in manifest.terms:
            angle = angle + term.coefficient * physical[term.column]
    return opened.wrap(pa.array(angle, from_pandas=True), manifest.label.column)


def _over_time(manifest: Manifest, columns: dict[str, FloatArray]) -> FloatArray:
    """Return the angles of a model that looks back; the rows are the ticks of one drive."""
    predictor = Predictor.of(manifest)
    if predictor.plan.facts:
        raise DataError(
            f"{manifest.name} needs what the car knows of itself, {', '.join(predictor.plan.facts)}"
            ", which a frame of signals does not say. Use: fleet-slip score"
        )
    signals = catalogue()
    used = predictor.plan.signals
    counts = {name: round_to_counts(columns[signals[name].column], signals[name]) for name in used}
    rows = pa.table({"tick": np.arange(len(next(iter(counts.values())))), **counts})
    return predictor(counts_of(rows, predictor.plan, {}))


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
