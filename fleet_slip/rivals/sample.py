"""A sample of a cohort's rows: what a Gram matrix does without, and these rivals cannot."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import Cohort, assign_folds
from fleet_slip.regression.folds import FoldAssignment
from fleet_slip.resources import read_sql
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.views import connect
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.tables import Warehouse

SAMPLE_ROWS = 20_000
"""Rows of a sample, about. Neighbours at 100 Hz say almost the same, so that little is lost."""


@dataclass(frozen=True)
class Sample:
    """Rows evenly spaced in time over all drives.

    Attributes:
        columns: SI columns of the inputs.
        inputs: shape (rows, columns).
        sideslip_rad: shape (rows,).
        drive_id: the drive of each row.
    """

    columns: tuple[str, ...]
    inputs: FloatArray
    sideslip_rad: FloatArray
    drive_id: NDArray[np.str_]

    def of(self, columns: tuple[str, ...]) -> FloatArray:
        """Return some of the inputs, shape (rows, columns)."""
        return self.inputs[:, [self.columns.index(column) for column in columns]]

    def folds(self, count: int) -> FoldAssignment:
        """Divide the rows as the regression's cross-validation divides the drives."""
        return assign_folds(self.drive_id.tolist(), "drive", count)


def draw_sample(
    warehouse: Warehouse, cohort: Cohort, signals: tuple[str, ...], rows: int = SAMPLE_ROWS
) -> Sample:
    """Draw about so many rows of a cohort that have the signals and the label.

    Raises `DataError` if there is none.
    """
    names = (*signals, catalogue().label)
    columns = [catalogue()[name].column for name in names]
    statement = read_sql("jobs", "sample.sql").format(
        columns=",\n    ".join(columns),
        complete=" AND ".join(f"{column} IS NOT NULL" for column in columns),
        samples_per_second=SAMPLE_RATE_HZ,
    )
    parameters = {
        "drives": sorted(set(cohort.drives["drive_id"].to_pylist())),
        "stride": max(1, cohort.rows // rows),
    }
    with connect(warehouse.root) as database, reading_files(database, "drawing a sample"):
        found = database.sql(statement, params=parameters).to_arrow_table()
    if not found.num_rows:
        raise DataError(f"no row of {cohort.condition.text!r} has all of {', '.join(names)}.")
    values = np.stack([found[column].to_numpy() for column in columns], axis=1)
    return Sample(
        columns=tuple(columns[:-1]),
        inputs=values[:, :-1],
        sideslip_rad=values[:, -1],
        drive_id=np.array(found["drive_id"].to_pylist()),
    )
