"""The sums of a cohort over each day, from Gram rows read batch by batch."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date

import pyarrow as pa

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.grams.cohorts.expansion import expansion_of
from fleet_slip.grams.cohorts.gram_cohort import empty_cohort, require_training
from fleet_slip.grams.cohorts.gram_reader import GramReader, open_grams
from fleet_slip.grams.cohorts.members import Members
from fleet_slip.grams.rows.gram_rows import Hashes, hash_numbers
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.inference.drive_moments import missing_signals_error
from fleet_slip.warehouse.condition import Condition, parse_cohort
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class DailySums:
    """The Gram of each day, and the number of drives in it.

    Attributes:
        left_out: drives of the condition that have no such Gram rows: their cars sent no log.
    """

    days: tuple[date, ...]
    grams: tuple[Gram, ...]
    drives: tuple[int, ...]
    left_out: int


def sum_days(
    source: Warehouse | GramReader,
    inputs: Sequence[str],
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> DailySums:
    """Add up a cohort's Gram rows with label and inputs, day by day. Raises like `load_cohort`."""
    signals = (*inputs, catalogue().label)
    days: dict[date, _Day] = defaultdict(_Day)
    found = False
    condition = parse_cohort(condition)
    with open_grams(source, feature_set, condition) as opened:
        expansion = expansion_of(opened, feature_set)
        for batch in opened.batches(condition):
            found = True
            require_training(batch["source"].unique().to_pylist(), condition)
            for names, table, chosen in expansion.tables(batch):
                if set(signals) <= set(names.split(",")):
                    rows = batch.filter(pa.array(chosen))
                    _add_rows(days, names, table.restrict(signals), rows)
        left_out = opened.count_left_out(condition)
        if not found:
            raise empty_cohort(source, condition, feature_set)
    if not days:
        raise missing_signals_error(signals)
    ordered = [days[day] for day in sorted(days)]
    return DailySums(
        tuple(sorted(days)),
        tuple(day.total() for day in ordered),
        tuple(day.members.count_drives(day.grams) for day in ordered),
        left_out,
    )


@dataclass
class _Day:
    """What a day comes to: its Grams and drives by the signals of the Gram rows."""

    grams: dict[str, Gram] = field(default_factory=dict)
    members: Members = field(default_factory=Members)

    def add(self, names: str, gram: Gram, drives: Hashes, vehicles: Hashes) -> None:
        """Add Gram rows of the same signals."""
        self.grams[names] = self.grams[names] + gram if names in self.grams else gram
        self.members.add(names, drives, vehicles)

    def total(self) -> Gram:
        """Return the sum of its Grams."""
        first, *others = (self.grams[names] for names in sorted(self.grams))
        return sum(others, first)


def _add_rows(days: dict[date, _Day], names: str, table: GramTable, rows: pa.RecordBatch) -> None:
    here = rows["day"].dictionary_encode()
    number, values = here.indices.to_numpy(), here.dictionary.to_pylist()
    ids = hash_numbers(rows["drive_id"])
    for i, total in enumerate(table.totals(number, len(values))):
        mine = rows["vehicle_id"].filter(pa.array(number == i)).unique()
        days[values[i]].add(names, total, ids[number == i], hash_numbers(mine))
