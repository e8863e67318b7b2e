"""A user's lines are typed. mypy --strict checks this file; running it checks the types' word."""

from typing import assert_type

import duckdb
import numpy as np
import polars as pl
from numpy.typing import NDArray

import fleet_slip
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.select import Selection


def test_a_users_lines_are_typed(fleet: Fleet) -> None:
    assert_type(fleet_slip.open("data"), Fleet)
    cohort = assert_type(fleet.cohort("adhesion > 0.9"), FleetCohort)
    selection = assert_type(cohort.select(models="table1", folds=3), Selection)
    assert_type(selection.winner.model.correlation, float)
    assert_type(fleet.status().problems, tuple[str, ...])
    log = assert_type(fleet.sql("FROM log LIMIT 10"), duckdb.DuckDBPyRelation).pl()
    model = assert_type(fleet.model("smoke@1"), ModelVersion)
    frame = pl.DataFrame(log)
    assert isinstance(assert_type(model.predict(frame), pl.Series), pl.Series)
    columns = {name: frame[name].to_numpy() for name in model.columns}
    angles = assert_type(model.predict(columns), NDArray[np.float64])
    assert angles.dtype == np.float64
