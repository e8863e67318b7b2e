"""Cohorts: Gram rows of the drives that satisfy an SQL predicate, each with a fold and a weight.

What looks at single drives has all Gram rows in memory; what compares given models needs the exact
sum of each fold alone, of any number of rows.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from fractions import Fraction
from functools import cache, cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, Hashes, IntArray
from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.drive_sources import RECEIVED, SCENARIO, TRAINING_DRIVES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import DataError, NotComputedError, QuestionError, RefusedError
from fleet_slip.grams.calibrated_columns import expansion_of
from fleet_slip.grams.drive_weights import FULL, weighted
from fleet_slip.grams.folding import (
    EACH,
    FOLD_KEYS,
    PARTS,
    FoldCount,
    Folding,
    FoldKey,
    assign_folds,
    require_blocks,
)
from fleet_slip.regression.choice import TrainingFolds
from fleet_slip.regression.drives import (
    ClusterUnit,
    DriveMoments,
    complete_cases,
    missing_signals_error,
)
from fleet_slip.regression.folds import CohortFolds
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.rendering import Remark
from fleet_slip.warehouse.gram_reader import HASHES, GramReader, OpenedGrams, open_grams
from fleet_slip.warehouse.predicate import Predicate, parse_cohort
from fleet_slip.warehouse.warehouse import Warehouse


def remark_left_out(drives: int, feature_set: str) -> Iterator[Remark]:
    """Yield how many drives have no Gram rows of a feature set, since their cars sent no log."""
    if drives:
        yield Remark(
            f"{pluralize(drives, 'drive')} without a log left out: cars send Gram rows of the "
            f"logged signals, not of the feature set {feature_set}."
        )


@dataclass(frozen=True)
class CompleteCases:
    """The drives of a cohort with all of some signals: a Gram row and metadata each, in order."""

    table: GramTable
    drives: pa.Table


@dataclass(frozen=True, kw_only=True)
class Cohort:
    """Gram rows of drives, each with a fold and a weight.

    A drive has several rows if a signal is in some of its rows only, or if its set has parts.

    Attributes:
        catalog: what the columns of the Gram rows are.
        predicate: which drives, by the columns of the view `drives`.
        logs_version, grams_version, feature_set: what was read.
        left_out: drives of the predicate that have no such Gram rows: their cars sent no log.
        drives: a line for each Gram row: whose it is, its signals, and of how many rows.
        tables: the Gram rows in the order of `drives`, by signals; none if only sums were kept.
        sums, folding: the Gram of each fold, if only these were kept, and what the folds are of.
        source: where the Gram rows were read, and can be read again.
        prior, weight: Gram rows of simulated drives, which are in no fold and always trained on,
            with this weight, where the others have 1.
    """

    catalog: Catalog
    predicate: Predicate
    logs_version: int
    grams_version: int
    feature_set: str = PLAIN
    left_out: int = 0
    drives: pa.Table
    tables: tuple[GramTable, ...] = ()
    sums: CohortFolds | None = None
    folding: Folding | None = None
    source: Warehouse | GramReader | None = None
    prior: "Cohort | None" = None
    weight: Fraction = Fraction(1)

    @property
    def rows(self) -> int:
        """Number of rows of the logs behind the cohort."""
        return int(pc.sum(self.drives["n"]).as_py())

    @cached_property
    def drive_numbers(self) -> IntArray:
        """The drive of each Gram row, numbered from 0."""
        indices = pc.dictionary_encode(self.drives["drive_id"].combine_chunks()).indices
        return np.asarray(indices.to_numpy(), dtype=np.int64)

    @property
    def drive_count(self) -> int:
        """Number of drives."""
        return int(pc.count_distinct(self.drives["drive_hash"]).as_py())

    @property
    def inputs(self) -> tuple[str, ...]:
        """What a search may choose of the columns that any drive has, in the set's order.

        With a prior those that it has as well.
        """
        present = {name for kind in _kinds(self.drives) for name in kind.split(",")}
        if self.prior is not None:
            present &= set(self.prior.inputs)
        return tuple(n for n in self.catalog.search_inputs(self.feature_set) if n in present)

    def gram_condition(self, inputs: Sequence[str]) -> str:
        """Return the SQL predicate on the view `grams` of the rows that a model is made of."""
        catalog, columns = self.catalog, self.catalog.calibrated
        stored = dict.fromkeys(columns[name].of if name in columns else name for name in inputs)
        names = ", ".join(f"'{name}'" for name in [*stored, catalog.signals.label])
        return (
            f"feature_set = '{catalog.identity(self.feature_set)}' AND {self.predicate.sql} AND "
            f"list_has_all(string_split(signals, ','), [{names}])"
        )

    def hash_drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the hashes of the drives trained on with all of some signals, once, sorted."""
        hashes: Hashes = np.unique(_lines_with(self.drives, signals)["drive_hash"].to_numpy())
        return hashes

    def count_vehicles_with(self, signals: Collection[str]) -> int:
        """Return the number of cars trained on that have all of some signals."""
        return int(pc.count_distinct(_lines_with(self.drives, signals)["vehicle_hash"]).as_py())

    def count_onboard_with(self, signals: Collection[str] = ()) -> int:
        """Return the number of drives trained on without a log that have all of some signals."""
        rows = _lines_with(self.drives, signals)
        received = rows.filter(pc.equal(rows["source"].cast(pa.string()), RECEIVED))
        return int(pc.count_distinct(received["drive_hash"]).as_py())

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the cohort into folds, of whole drives unless by `part`.

        By a key of `FOLD_KEYS`: a fold for each value, or hashed into `count` if there are more
        (`EACH`: never); by `speed` in bands; by `part` as the feature set has them. Raises
        `QuestionError` if it has none. Where only sums were kept the Gram rows are read again.
        """
        folds = self._own_folds(by, count)
        if self.prior is None:
            return folds
        auxiliary = tuple(table.total() for table in self.prior.tables)
        return replace(folds, auxiliary=auxiliary, weight=self.weight)

    def _own_folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        folding = Folding(by=by, count=count)
        if self.sums is not None and folding == self.folding:
            return self.sums
        if self.sums is not None and self.source is not None:
            again = load_cohort(self.source, self.predicate, self.feature_set, folding)
            return again._own_folds(by, count)
        require_blocks(self.catalog, self.feature_set, by)
        values = self.drives[FOLD_KEYS[by]].to_pylist()
        return CohortFolds.from_tables(
            self.tables, assign_folds(values, by, count), self.drive_numbers
        )

    def complete_cases(self, inputs: Sequence[str]) -> CompleteCases:
        """Return the drives with the label and all inputs, a Gram row each. Raises `DataError`."""
        if self.sums is not None and self.source is not None:
            return load_cohort(self.source, self.predicate, self.feature_set).complete_cases(inputs)
        table, mask = complete_cases(self.tables, [*inputs, self.catalog.signals.label])
        rows = np.flatnonzero(mask)
        _, first, number = np.unique(
            self.drive_numbers[rows], return_index=True, return_inverse=True
        )
        if len(first) == len(rows):
            return CompleteCases(table, self.drives.take(rows))
        return CompleteCases(table.merged(number), self.drives.take(rows[first]))

    def part(self, wanted: BoolArray) -> "Cohort":
        """Return the cohort with some of its Gram rows only; the mask lists them all."""
        stops = np.cumsum([len(table) for table in self.tables])[:-1]
        masks = np.split(wanted, stops)
        kept = [table.take(m) for table, m in zip(self.tables, masks, strict=True) if m.any()]
        return replace(self, tables=tuple(kept), drives=self.drives.filter(pa.array(wanted)))

    def weighted(self, parts: IntArray) -> "Cohort":
        """Return the cohort with each of its Gram rows so many times, and `FULL` times the others.

        Rows of weight zero are left out.
        """
        kept, left = self.part(parts > 0), parts[parts > 0]
        each = np.split(left, np.cumsum([len(one) for one in kept.tables])[:-1])
        prior = self.prior
        if prior is not None:
            prior = prior.weighted(np.full(len(prior.drives), FULL))
        tables = tuple(weighted(one, some) for one, some in zip(kept.tables, each, strict=True))
        return replace(kept, tables=tables, prior=prior)


def _kinds(drives: pa.Table) -> list[str]:
    return list(drives["signals"].unique().to_pylist())


def _lines_with(drives: pa.Table, signals: Collection[str]) -> pa.Table:
    """Return the lines of the Gram rows that have all of some signals."""
    wanted = set(signals)
    kinds = [kind for kind in _kinds(drives) if wanted <= set(kind.split(","))]
    return drives.filter(pc.is_in(drives["signals"], pa.array(kinds, pa.string())))


def load_cohort(
    source: Warehouse | GramReader,
    predicate: str | Predicate = TRAINING_DRIVES,
    feature_set: str = PLAIN,
    folding: Folding | None = None,
) -> Cohort:
    """Read the Gram rows of the drives that satisfy a predicate.

    With a `folding` only the sum of each fold is kept, which takes little memory. Raises
    `QuestionError` for an invalid predicate, `DataError` if no drive satisfies it, for a single
    fold, or if the set was not computed for all logs, `RefusedError` for drives of evaluation
    scenarios.
    """
    catalog = source.catalog
    predicate = parse_cohort(catalog.signals, predicate)
    if folding is not None:
        require_blocks(catalog, feature_set, folding.by)
    with open_grams(source, feature_set, predicate) as opened:
        if folding is None:
            rows = opened.rows(predicate)
            require_training(rows["source"].unique().to_pylist(), predicate)
            kept = _expand_rows(opened, rows)
            if not kept["tables"]:  # no row, or none of changes
                raise empty_cohort_error(opened, predicate)
        else:
            names, fold_of = _find_folds(opened, folding, predicate)
            grams, drives = _add_up(opened, predicate, names, fold_of)
            kept = {"drives": drives, "sums": _used_folds(names, grams, drives), "folding": folding}
        return Cohort(
            catalog=catalog,
            predicate=predicate,
            logs_version=opened.logs_version,
            grams_version=opened.grams_version,
            feature_set=catalog.name_of(opened.identity),
            left_out=opened.count_left_out(predicate),
            source=source,
            **kept,
        )


def _expand_rows(opened: OpenedGrams, rows: pa.Table) -> dict[str, Any]:
    expansion = expansion_of(opened)
    parts = list(expansion.tables(rows))
    lines = rows.drop_columns(["sums", "products", "signals"])
    # Rows whose calibrated columns are not the same are apart now: their lines follow them.
    some = [_with_signals(lines.filter(pa.array(here)), signals) for signals, _, here in parts]
    drives = pa.concat_tables(some) if some else lines
    return {"tables": tuple(table for _, table, _ in parts), "drives": drives}


def with_gram_rows(cohort: Cohort, rows: pa.Table) -> Cohort:
    """Return a cohort of other Gram rows, such as those of parts of its drives.

    Beside the columns of `Cohort.drives` these have `sums`, `products` and `signals`, and are
    sorted by signals.
    """
    if cohort.source is None:
        raise ValueError("it is not known where the cohort was read")
    with open_grams(cohort.source, cohort.feature_set, cohort.predicate) as opened:
        return replace(cohort, **_expand_rows(opened, rows))


def _with_signals(lines: pa.Table, signals: str) -> pa.Table:
    """Return lines of Gram rows that all have some signals, whose names may be long."""
    same = pa.DictionaryArray.from_arrays(np.zeros(len(lines), dtype=np.int32), [signals])
    return lines.append_column("signals", same)


def require_training(sources: Iterable[str], predicate: Predicate) -> None:
    """Raise `RefusedError` if drives of a scenario are among those of a predicate."""
    if SCENARIO in sources:
        raise RefusedError(
            f"the cohort {predicate.quoted} has drives of evaluation scenarios, which no model "
            f"may be trained on. Add to the predicate: AND {TRAINING_DRIVES}"
        )


def empty_cohort_error(opened: OpenedGrams, predicate: Predicate) -> DataError:
    """Return the error that tells why a predicate leaves no drive."""
    if left_out := opened.count_left_out(predicate):
        return NotComputedError(
            f"all {pluralize(left_out, 'drive')} of the cohort {predicate.quoted} have no log: "
            "their cars sent Gram rows of logged signals. Use --features signals."
        )
    feature_set = opened.catalog.feature_set(opened.catalog.name_of(opened.identity))
    if feature_set.change_s:
        return DataError(
            f"no drive of the cohort {predicate.quoted} has satellite fixes "
            f"{feature_set.change_text} apart, so there is no course to learn from. Choose another "
            "cohort, or map the course and ingest again: docs/course.md."
        )
    examples = opened.database.execute(
        "SELECT string_agg(DISTINCT source, ', ' ORDER BY source), "
        "string_agg(DISTINCT campaign, ', ' ORDER BY campaign) FROM grams "
        f"WHERE {TRAINING_DRIVES}"
    ).fetchone()
    sources, campaigns = examples or ("", "")
    return DataError(
        f"no drive matches the cohort predicate {predicate.quoted}. The warehouse has sources "
        f'{sources} and campaigns {campaigns}. See the columns with: fleet-slip sql "DESCRIBE '
        'drives"'
    )


# The sums of a cohort over its folds, from Gram rows read batch by batch.

FoldOf = Callable[[pa.RecordBatch], IntArray]
"""Returns the fold of each Gram row, by its metadata."""


def _add_up(
    opened: OpenedGrams, predicate: Predicate, names: Sequence[object], fold_of: FoldOf
) -> tuple[dict[str, list[Gram]], pa.Table]:
    """Return the exact sums of Gram rows, by signals and fold, and whose each row is."""
    expansion = expansion_of(opened)
    grams: dict[str, list[Gram]] = {}
    lines: list[pa.Table] = []
    for batch in opened.batches(predicate, *HASHES):
        require_training(batch["source"].unique().to_pylist(), predicate)
        folds = fold_of(batch)
        some = pa.table({name: batch[name] for name in ("n", "source", *HASHES[:2])})
        some = some.append_column("fold", pa.array(folds))
        for signals, table, here in expansion.tables(batch):
            totals, before = table.totals(folds[here], len(names)), grams.get(signals)
            grams[signals] = list(map(Gram.__add__, before, totals)) if before else totals
            # Filtered lines are copies: a column by itself would keep all of its batch.
            lines.append(_with_signals(some.filter(pa.array(here)), signals))
    if not grams:
        raise empty_cohort_error(opened, predicate)
    return grams, pa.concat_tables(lines)


def _find_folds(
    opened: OpenedGrams, folding: Folding, predicate: Predicate
) -> tuple[Sequence[str], FoldOf]:
    """Return the folds that there may be, and which a Gram row is in. Raises like `load_cohort`."""
    key = FOLD_KEYS[folding.by]
    dealt = folding.by in ("drive", "vehicle") and folding.count != EACH
    found = opened.values_of(key, predicate, int(folding.count) + 1 if dealt else None)
    if dealt and len(found) > (count := int(folding.count)):
        hashed = key.removesuffix("_id") + "_hash"
        names = [str(fold + 1) for fold in range(count)]
        return names, lambda rows: (rows[hashed].to_numpy() % count).astype(np.int64)
    if not len(found):
        raise empty_cohort_error(opened, predicate)
    assignment = assign_folds(found.to_pylist(), folding.by, folding.count)
    return assignment.names, lambda rows: assignment.fold[_places(rows[key], found)]


def _places(values: pa.Array, known: pa.Array) -> IntArray:
    places: IntArray = pc.index_in(values.cast(known.type), value_set=known).to_numpy()
    return places


def _used_folds(
    names: Sequence[str], grams: dict[str, list[Gram]], drives: pa.Table
) -> CohortFolds:
    """Return the folds that have drives. Raises `DataError` if only one has."""
    order = sorted(grams)
    used = [fold for fold in range(len(names)) if any(grams[kind][fold].n for kind in order)]
    if len(used) < 2:
        raise DataError(
            "cross-validation needs at least two folds, and the cohort has one: "
            f"{names[used[0]]}. Widen the cohort, or fold by another key."
        )

    @cache
    def count_drives(kinds: tuple[int, ...]) -> int:
        mine = pc.is_in(drives["signals"], pa.array([order[i] for i in kinds]))
        return int(pc.count_distinct(drives["drive_hash"].filter(mine)).as_py())

    return CohortFolds(
        tuple(names[fold] for fold in used),
        tuple(tuple(grams[kind][fold] for fold in used) for kind in order),
        lambda tables: count_drives(tuple(tables)),
    )


@dataclass(frozen=True)
class DailySums:
    """The Gram of each day, and the number of drives in it.

    `left_out` drives of the predicate have no such Gram rows: their cars sent no log.
    """

    days: tuple[date, ...]
    grams: tuple[Gram, ...]
    drives: tuple[int, ...]
    left_out: int


def sum_days(
    source: Warehouse | GramReader,
    inputs: Sequence[str],
    predicate: str | Predicate = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> DailySums:
    """Add up a cohort's Gram rows with label and inputs, day by day. Raises like `load_cohort`."""
    signals = (*inputs, source.catalog.signals.label)
    predicate = parse_cohort(source.catalog.signals, predicate)
    with open_grams(source, feature_set, predicate) as opened:
        found = opened.values_of("day", predicate).sort()
        days: list[date] = found.to_pylist()
        sums, lines = _add_up(opened, predicate, days, lambda rows: _places(rows["day"], found))
        left_out = opened.count_left_out(predicate)
    complete_cases = [one for kind, one in sums.items() if set(signals) <= set(kind.split(","))]
    if not complete_cases:
        raise missing_signals_error(signals)
    grams = [
        sum((one[day].restrict(signals) for one in complete_cases), Gram.zero(signals))
        for day in range(len(days))
    ]
    of_drives = _lines_with(lines, signals).group_by("drive_hash").aggregate([("fold", "min")])
    drives = np.bincount(of_drives["fold_min"].to_numpy(), minlength=len(days)).tolist()
    used = [day for day, gram in enumerate(grams) if gram.n]
    return DailySums(
        tuple(days[day] for day in used),
        tuple(grams[day] for day in used),
        tuple(drives[day] for day in used),
        left_out,
    )


# A cohort made ready for one set of inputs: folds, and moments of each drive.


def clustered_moments(
    served: CompleteCases,
    cluster: ClusterUnit | None = None,
    *,
    intercept: bool = True,
) -> DriveMoments:
    """Return the moments of each drive, and which of them are one piece of evidence.

    By default cars where there are several, else drives. Without an intercept moments are about
    zero.
    """
    table = served.table if intercept else served.table.about_origin()
    cars = served.drives["vehicle_id"].to_pylist()
    unit = cluster or ("vehicle" if len(set(cars)) > 1 else "drive")
    owners = cars if unit == "vehicle" else served.drives["trip"].to_pylist()
    number = {owner: i for i, owner in enumerate(sorted(set(owners), key=str))}
    if unit == "drive" and len(number) == len(owners):
        return DriveMoments.from_table(table)
    return DriveMoments.from_table(table, np.array([number[one] for one in owners]), unit)


def drive_folds(
    cohort: Cohort,
    inputs: Sequence[str],
    folding: Folding,
    *,
    cluster: ClusterUnit | None = None,
    intercept: bool = True,
) -> tuple[TrainingFolds, IntArray]:
    """Divide the drives with all the inputs into folds; return the fold of each, too.

    Raises `DataError` if no drive has them all, and `QuestionError` for folds of parts of drives.
    """
    if folding.by == PARTS:
        raise QuestionError(
            f"with folds by {folding.by} there are no drives to hold out. Fold by drive for this."
        )
    served = cohort.complete_cases(inputs)
    assignment = assign_folds(
        served.drives[FOLD_KEYS[folding.by]].to_pylist(), folding.by, folding.count
    )
    label, scales = cohort.catalog.signals.label, cohort.catalog.input_scales
    folds = CohortFolds.from_tables([served.table], assignment).complete_cases(inputs, label)
    moments = clustered_moments(served, cluster, intercept=intercept)
    return TrainingFolds(folds, moments, scales, intercept), assignment.fold
