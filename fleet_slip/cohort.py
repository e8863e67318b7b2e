"""Cohorts: the Gram rows of the drives that satisfy an SQL condition."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_slip.connection import connect
from fleet_slip.database import database_errors, one_query
from fleet_slip.errors import RefusedError, SelectionError
from fleet_slip.gram import GramTable, packed_size
from fleet_slip.regression.folds import Assignment, CohortFolds, by_hash, by_value
from fleet_slip.resources import read_sql
from fleet_slip.warehouse import Warehouse

FOLD_KEYS = {
    "drive": "drive_id",
    "vehicle": "vehicle_id",
    "track": "track",
    "day": "day",
    "mass": "mass_kg",
    "adhesion": "adhesion",
}
"""What a fold may be made of, and the column that tells."""

SCENARIO = "scenario"
"""Source of the drives that models are evaluated on, and must never be trained on."""

ALL_DRIVES = "true"
TRAINING_DRIVES = f"source <> '{SCENARIO}'"


@dataclass(frozen=True)
class Cohort:
    """Gram rows, grouped by the signals that they have.

    Attributes:
        condition: SQL condition on the columns of the view `drives`.
        tables: one `GramTable` for each set of signals.
        drives: metadata of each Gram row, in the order of the tables.
        logs_version, grams_version: versions of the Delta tables that were read.
    """

    condition: str
    tables: tuple[GramTable, ...]
    drives: pa.Table
    logs_version: int
    grams_version: int

    @property
    def rows(self) -> int:
        """Number of rows of the logs behind the cohort."""
        return int(sum(table.n.sum() for table in self.tables))

    def folds(self, by: str, count: int) -> CohortFolds:
        """Divide the cohort into folds of whole drives.

        By `drive`: hashed into `count` folds. By another key of `FOLD_KEYS`: one fold for each
        value, or hashed into `count` folds if there are more values than that.
        """
        values = self.drives[FOLD_KEYS[by]].to_pylist()
        return CohortFolds.of(self.tables, assign(values, by, count))


def assign(values: Sequence[Any], by: str, count: int) -> Assignment:
    """Assign drives to folds by the values of a fold key."""
    if by == "drive" or len(set(values)) > count:
        return by_hash([str(value) for value in values], count)
    return by_value(values)


def load_cohort(warehouse: Warehouse, condition: str = TRAINING_DRIVES) -> Cohort:
    """Read the Gram rows of the drives that satisfy a condition.

    Raises `SelectionError` if the condition is not valid SQL or no drive satisfies it, and
    `RefusedError` if a drive of an evaluation scenario does.
    """
    logs, grams = warehouse.logs.snapshot(), warehouse.grams.snapshot()
    if not grams.rows:
        raise SelectionError(
            f"{warehouse.root}: there are no Gram rows yet. Run: fleet-slip simulate CAMPAIGN (or "
            "fleet-slip ingest FILE --mapping M), then fleet-slip gram."
        )
    with connect(warehouse.root) as database:
        rows = _query(database, condition)
        if not rows.num_rows:
            raise SelectionError(_nothing(database, condition))
    if SCENARIO in rows["source"].unique().to_pylist():
        raise RefusedError(
            f"the cohort {condition!r} has drives of evaluation scenarios, which no model may be "
            f"trained on. Add to the condition: AND {TRAINING_DRIVES}"
        )
    tables = tuple(
        _gram_table(signals, rows.filter(pc.equal(rows["signals"], signals)))
        for signals in rows["signals"].unique().to_pylist()
    )
    return Cohort(
        condition=condition,
        tables=tables,
        drives=rows.drop_columns(["sums", "products"]),
        logs_version=logs.version or 0,
        grams_version=grams.version or 0,
    )


def _query(database: duckdb.DuckDBPyConnection, condition: str) -> pa.Table:
    statement = read_sql("jobs", "cohort.sql").format(condition=condition)
    with database_errors(f"the cohort {condition!r}"):
        return database.sql(one_query(database, statement)).to_arrow_table()


def _gram_table(signals: str, rows: pa.Table) -> GramTable:
    names = tuple(signals.split(","))
    k = len(names)
    return GramTable(
        names,
        rows["n"].combine_chunks().to_numpy(),
        _matrix(rows["sums"], k),
        _matrix(rows["products"], packed_size(k)),
    )


def _matrix(lists: pa.ChunkedArray, width: int) -> NDArray[np.int64]:
    values: NDArray[np.int64] = lists.combine_chunks().flatten().to_numpy()
    return values.reshape(-1, width)


def _nothing(database: duckdb.DuckDBPyConnection, condition: str) -> str:
    examples = database.execute(
        "SELECT string_agg(DISTINCT source, ', '), string_agg(DISTINCT campaign, ', ') FROM grams"
    ).fetchone()
    sources, campaigns = examples or ("", "")
    return (
        f"no drive satisfies the cohort condition {condition!r}. The warehouse has sources "
        f"{sources} and campaigns {campaigns}. See the columns with: "
        'fleet-slip sql "DESCRIBE drives"'
    )
