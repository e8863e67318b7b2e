"""Cohorts: the Gram rows of the drives that satisfy an SQL condition."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import SCENARIO, TRAINING_DRIVES
from fleet_slip.errors import DataError, NotComputedError, RefusedError
from fleet_slip.grams.cohorts.cohort_origin import CohortOrigin
from fleet_slip.grams.cohorts.expansion import expansion_of
from fleet_slip.grams.cohorts.folding import (
    FOLD_KEYS,
    FoldCount,
    FoldKey,
    assign_folds,
    require_divided,
)
from fleet_slip.grams.cohorts.gram_reader import GramReader, OpenedGrams, open_grams
from fleet_slip.grams.cohorts.members import Hashed, Members, received_among
from fleet_slip.grams.rows.gram_rows import hash_numbers
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.inference.drive_moments import serving_drives
from fleet_slip.regression.validation.folds import CohortFolds
from fleet_slip.warehouse.condition import Condition, asking, parse_cohort
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of


@dataclass(frozen=True)
class Served:
    """The drives of a cohort with all of some signals: a Gram row and metadata each, in order."""

    table: GramTable
    drives: pa.Table


@dataclass(frozen=True, kw_only=True)
class Cohort(CohortOrigin):
    """Gram rows in a `GramTable` for each set of signals, and metadata of each row in their order.

    A drive has several rows if a signal is in some of its rows only, or if its set has parts.
    """

    tables: tuple[GramTable, ...]
    drives: pa.Table

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
                {name: Hashed(some) for name, some in zip(names, parts, strict=True)}
                for parts in (drives, vehicles, received)
            )
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Signals and features that any of the drives has, in the order of the feature set."""
        return self.inputs_among(name for table in self.tables for name in table.signals)

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the cohort into folds, of whole drives unless by `row`.

        By a key of `FOLD_KEYS`: a fold for each value, or hashed into `count` if there are more
        (`EACH`: never); by `speed` in bands; by `part` or `row` as the feature set has them. Raises
        `QuestionError` if it has none.
        """
        require_divided(self.feature_set, by, count)
        values = self.drives[FOLD_KEYS[by]].to_pylist()
        return CohortFolds.of(self.tables, assign_folds(values, by, count), self.drive_numbers)

    def serving(self, inputs: Sequence[str]) -> Served:
        """Return the drives with the label and all inputs, a Gram row each. Raises `DataError`."""
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
        return replace(self, tables=tuple(kept), drives=self.drives.filter(pa.array(wanted)))


def load_cohort(
    warehouse: Warehouse | GramReader,
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> Cohort:
    """Read the Gram rows of the drives that satisfy a condition.

    Raises `QuestionError` for an invalid
    condition, `DataError` if no drive satisfies it or the set was not computed for all logs,
    `RefusedError` for drives of evaluation scenarios.
    """
    condition = parse_cohort(condition)
    with open_grams(warehouse, feature_set, condition) as opened:
        expansion = expansion_of(opened, feature_set)
        statement = opened.statement("cohort.sql", condition)
        with asking(opened.database, condition):
            rows = opened.database.sql(statement).to_arrow_table()
        origin = opened.origin(condition)
        if not rows.num_rows:
            raise empty_cohort_error(opened, condition)
    require_training(rows["source"].unique().to_pylist(), condition)
    parts = list(expansion.tables(rows))
    if not parts:  # of changes, and there are none
        raise empty_cohort(warehouse, condition, feature_set)
    # Rows whose calibrated columns are not the same are apart now: their metadata follows them.
    order = np.concatenate([np.flatnonzero(here) for _, _, here in parts])
    return Cohort(
        **vars(origin),
        tables=tuple(table for _, table, _ in parts),
        drives=rows.drop_columns(["sums", "products"]).take(order),
    )


def require_training(sources: Iterable[str], condition: Condition) -> None:
    """Raise `RefusedError` if drives of a scenario are among those of a condition."""
    if SCENARIO in sources:
        raise RefusedError(
            f"the cohort {condition.text!r} has drives of evaluation scenarios, which no model "
            f"may be trained on. Add to the condition: AND {TRAINING_DRIVES}"
        )


def empty_cohort(
    source: Warehouse | GramReader, condition: Condition, feature_set: str
) -> DataError:
    """Return the error that tells why a condition leaves no drive, from all Gram rows."""
    with open_grams(source, feature_set, condition) as opened:  # all of them: it says what there is
        return empty_cohort_error(opened, condition)


def empty_cohort_error(opened: OpenedGrams, condition: Condition) -> DataError:
    """Return the error that tells why a condition leaves no drive."""
    if left_out := opened.count_left_out(condition):
        return NotComputedError(
            f"all {number_of(left_out, 'drive')} of the cohort {condition.text!r} are of cars that "
            "sent Gram rows of the logged signals and no log. Select with features = signals."
        )
    one = features().feature_set(features().name_of(opened.identity))
    if one.change_s:
        return DataError(
            f"no drive of the cohort {condition.text!r} has fixes of a satellite receiver that are "
            f"{one.change_text} apart: nothing tells the course. Choose another cohort, or map the "
            "course and ingest again: docs/course.md."
        )
    examples = opened.database.execute(
        "SELECT string_agg(DISTINCT source, ', ' ORDER BY source), "
        "string_agg(DISTINCT campaign, ', ' ORDER BY campaign) FROM grams "
        f"WHERE {TRAINING_DRIVES}"
    ).fetchone()
    sources, campaigns = examples or ("", "")
    return DataError(
        f"no drive satisfies the cohort condition {condition.text!r}. The warehouse has sources "
        f"{sources} and campaigns {campaigns}. See the columns with: "
        'fleet-slip sql "DESCRIBE drives"'
    )
