"""Cohorts: the Gram rows of the drives that satisfy an SQL condition."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import SCENARIO, TRAINING_DRIVES
from fleet_slip.errors import DataError, QuestionError, RefusedError
from fleet_slip.grams.cohorts.empty_cohort import empty_cohort_error
from fleet_slip.grams.cohorts.expansion import expansion_of
from fleet_slip.grams.cohorts.folding import (
    BANDS,
    EACH,
    FOLD_KEYS,
    PARTS,
    ROW_FOLDS,
    FoldCount,
    FoldKey,
)
from fleet_slip.grams.cohorts.members import Hashed, Members, hash_numbers, received_among
from fleet_slip.grams.cohorts.outweighing import Outweighing
from fleet_slip.grams.cohorts.reader import GramReader, open_grams
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.inference.drive_moments import serving_drives
from fleet_slip.regression.validation.folds import (
    CohortFolds,
    FoldAssignment,
    by_band,
    by_hash,
    by_value,
)
from fleet_slip.warehouse.condition import Condition, asking, parse_condition
from fleet_slip.warehouse.minimum_cohort import minimum_vehicles, require_vehicles
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Served:
    """The drives of a cohort that have all of some signals, one Gram row each.

    Attributes:
        table: their Gram rows, restricted to the signals.
        drives: metadata of each, in the same order.
    """

    table: GramTable
    drives: pa.Table


@dataclass(frozen=True)
class Cohort:
    """Gram rows, grouped by the signals that they have.

    A drive has several Gram rows if it has a signal in some of its rows only, or if the feature set
    divides its rows.

    Attributes:
        condition: which drives, by the columns of the view `drives`.
        tables: one `GramTable` for each set of signals.
        drives: metadata of each Gram row, in the order of the tables.
        logs_version, grams_version: versions of the Delta tables that were read.
        feature_set: which Gram rows these are.
        left_out: drives of the condition that have no such Gram rows: their cars sent no log.
        revoked: how many drives of a car are left out, since a revoked key signed them.
        outweighing: which are, since their cars would outweigh the others with them.
    """

    condition: Condition
    tables: tuple[GramTable, ...]
    drives: pa.Table
    logs_version: int
    grams_version: int
    feature_set: str = PLAIN
    left_out: int = 0
    revoked: Mapping[str, int] = field(default_factory=dict)
    outweighing: tuple[Outweighing, ...] = ()

    @property
    def rows(self) -> int:
        """Number of rows of the logs behind the cohort."""
        return int(sum(table.n.sum() for table in self.tables))

    @cached_property
    def drive_numbers(self) -> IntArray:
        """The drive of each Gram row, numbered from 0."""
        indices = pc.dictionary_encode(self.drives["drive_id"].combine_chunks()).indices
        return np.asarray(indices.to_numpy(), dtype=np.int64)

    @property
    def drive_count(self) -> int:
        """Number of drives."""
        return int(self.drive_numbers.max()) + 1

    @property
    def members(self) -> Members:
        """Which drives and cars the Gram rows are of."""
        hashes, cars = (hash_numbers(self.drives[name]) for name in ("drive_id", "vehicle_id"))
        stops = np.cumsum([len(table) for table in self.tables])[:-1]
        names = [",".join(table.signals) for table in self.tables]
        drives, vehicles = np.split(hashes, stops), np.split(cars, stops)
        came = np.split(received_among(self.drives), stops)
        received = [some[mask] for some, mask in zip(drives, came, strict=True)]
        return Members(
            *(
                {name: Hashed.of(some) for name, some in zip(names, parts, strict=True)}
                for parts in (drives, vehicles, received)
            )
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Signals and features that any of the drives has, in the order of the feature set."""
        found = {name for table in self.tables for name in table.signals}
        return tuple(
            name for name in features().feature_set(self.feature_set).inputs if name in found
        )

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the cohort into folds, of whole drives unless by `row`.

        By `drive` or another key of `FOLD_KEYS`: one fold for each value, or hashed into `count`
        folds if there are more values than that; by `speed`, cut into `count` bands. With `EACH`,
        every drive or value is a fold. By `part` or `row`: the parts or the folds of single rows
        that the feature set made. Raises `QuestionError` if it made none.
        """
        require_divided(self.feature_set, by, count)
        values = self.drives[FOLD_KEYS[by]].to_pylist()
        return CohortFolds.of(self.tables, assign_folds(values, by, count), self.drive_numbers)

    def serving(self, inputs: Sequence[str]) -> Served:
        """Return the drives that have the label and all the inputs, one Gram row each.

        Raises `DataError` if there is none.
        """
        table, mask = serving_drives(self.tables, [*inputs, catalogue().label])
        rows = np.flatnonzero(mask)
        numbers = self.drive_numbers[rows]
        order = np.argsort(numbers, kind="stable")
        _, first = np.unique(numbers[order], return_index=True)
        if len(first) == len(rows):
            return Served(table, self.drives.take(rows))
        merged = GramTable(
            table.signals,
            *(
                np.add.reduceat(part[order], first)
                for part in (table.n, table.sums, table.products)
            ),
        )
        return Served(merged, self.drives.take(rows[order[first]]))

    def part(self, wanted: BoolArray) -> "Cohort":
        """Return the cohort with some of its Gram rows only; the mask lists them all."""
        stops = np.cumsum([len(table) for table in self.tables])[:-1]
        masks = np.split(wanted, stops)
        kept = [table.take(m) for table, m in zip(self.tables, masks, strict=True) if m.any()]
        return Cohort(
            self.condition,
            tuple(kept),
            self.drives.filter(pa.array(wanted)),
            self.logs_version,
            self.grams_version,
            self.feature_set,
            self.left_out,
            self.revoked,
            self.outweighing,
        )

    def gram_condition(self, inputs: Sequence[str]) -> str:
        """Return the SQL condition on the view `grams` of the rows that a model is made of."""
        return gram_condition(self.condition, self.feature_set, inputs, self.outweighing)


def gram_condition(
    condition: Condition,
    feature_set: str,
    inputs: Sequence[str],
    outweighing: Sequence[Outweighing],
) -> str:
    """Return the SQL condition on the view `grams` of a cohort's rows that have some inputs."""
    known = features().calibrated
    stored = dict.fromkeys(known[name].of if name in known else name for name in inputs)
    wanted = ", ".join(f"'{name}'" for name in [*stored, catalogue().label])
    return (
        f"feature_set = '{features().identity(feature_set)}' AND {condition.sql} AND "
        f"list_has_all(string_split(signals, ','), [{wanted}])"
        + "".join(f" AND NOT {one.condition}" for one in outweighing)
    )


MOST_FOLDS = 10_000
"""Each fold is an exact fit of every model."""


def require_divided(feature_set: str, by: str, count: FoldCount) -> None:
    """Raise `QuestionError` if a feature set has not divided the rows of drives as folds need."""
    if by == ROW_FOLDS:
        _require_row_folds(feature_set, count)
    one = features().feature_set(feature_set)
    if by == PARTS and not (one.regimes or one.block_s):
        known = ", ".join(n for n, s in features().sets.items() if s.regimes or s.block_s)
        raise QuestionError(
            f"the feature set {feature_set} does not divide the rows of a drive. Feature sets with "
            f"bands or blocks: {known}."
        )


def _require_row_folds(feature_set: str, count: FoldCount) -> None:
    made = features().feature_set(feature_set).row_folds
    if made is None:
        known = ", ".join(name for name, one in features().sets.items() if one.row_folds)
        raise QuestionError(
            f"the Gram rows of the feature set {feature_set} are of whole drives: folds of rows "
            f"are made when the logs are read. Feature sets that make them: {known}."
        )
    if count == EACH or count > made:
        raise QuestionError(
            f"the feature set {feature_set} made {made} folds of rows; choose no more."
        )


def assign_folds(values: Sequence[Any], by: str, count: FoldCount) -> FoldAssignment:
    """Assign Gram rows to folds by the values of a fold key.

    Raises `DataError` if there are not two folds, or too many.
    """
    if count == EACH:
        if (number := len(set(values))) > MOST_FOLDS:
            raise DataError(
                f"the cohort has {number:,}, and at most {MOST_FOLDS:,} can be folds of their own. "
                f"Fold by another key than {by}, or say how many folds."
            )
        return by_value(values)
    if by == BANDS:
        return by_band(values, count)
    if by == ROW_FOLDS:
        return by_value([(int(value) - 1) % count + 1 for value in values])
    if len(set(values)) > count:
        return by_hash([str(value) for value in values], count)
    return by_value(values)


def load_cohort(
    warehouse: Warehouse | GramReader,
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
    *,
    training: bool = True,
) -> Cohort:
    """Read the Gram rows of the drives that satisfy a condition.

    For `training` what outweighs the others is not among them. Raises `QuestionError` if the
    condition is not one SQL expression on the columns of `drives`, `DataError` if no drive
    satisfies it or the feature set has not been computed for all logs, and `RefusedError` if a
    drive of an evaluation scenario satisfies it.
    """
    condition = parse_condition(condition)
    with open_grams(warehouse, feature_set, condition, training=training) as opened:
        expansion = expansion_of(opened, feature_set)
        statement = opened.statement("cohort.sql", condition)
        with asking(opened.database, condition):
            rows = opened.database.sql(statement).to_arrow_table()
        left_out, revoked = opened.count_left_out(condition), opened.revoked(condition)
        if not rows.num_rows:
            raise empty_cohort_error(opened, condition)
    require_training(rows["source"].unique().to_pylist(), condition)
    parts = list(expansion.tables(rows))
    # Rows whose calibrated columns are not the same are apart now: their metadata follows them.
    order = np.concatenate([np.flatnonzero(here) for _, _, here in parts])
    if minimum_vehicles():
        for names, _, here in parts:
            cars = rows["vehicle_id"].filter(pa.array(here)).unique()
            require_vehicles(len(cars), f"the cohort {condition.text!r} with the signals {names}")
    return Cohort(
        condition=condition,
        tables=tuple(table for _, table, _ in parts),
        drives=rows.drop_columns(["sums", "products"]).take(order),
        logs_version=opened.logs_version,
        grams_version=opened.grams_version,
        feature_set=feature_set,
        left_out=left_out,
        revoked=revoked,
        outweighing=opened.outweighing,
    )


def require_training(sources: Iterable[str], condition: Condition) -> None:
    """Raise `RefusedError` if drives of a scenario are among those of a condition."""
    if SCENARIO in sources:
        raise RefusedError(
            f"the cohort {condition.text!r} has drives of evaluation scenarios, which no model "
            f"may be trained on. Add to the condition: AND {TRAINING_DRIVES}"
        )
