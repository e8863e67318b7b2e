"""Cohorts: Gram rows of the drives that satisfy an SQL predicate, with folds and weights.

Methods on single drives need all Gram rows in memory. The comparison of listed models needs only
the exact sum of each fold, for any number of rows.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from fractions import Fraction
from functools import cache, cached_property
from hashlib import sha256
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import Field

from fleet_slip.arrays import BoolArray, FloatArray, Hashes, IntArray
from fleet_slip.base import Record, pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import LONGEST_PAUSE_S, RECEIVED, SCENARIO, TRAINING_DRIVES
from fleet_slip.config import Config
from fleet_slip.errors import DataError, NotComputedError, QuestionError, RefusedError, UsageError
from fleet_slip.grams.calibrated_columns import expansion_of
from fleet_slip.regression.folds import CohortFolds, FoldAssignment, by_hash, by_value
from fleet_slip.regression.gram import Gram, GramTable, complete_cases, missing_signals_error
from fleet_slip.regression.inference import ClusterUnit, DriveMoments
from fleet_slip.rendering import Remark
from fleet_slip.warehouse.database import Predicate, parse_cohort
from fleet_slip.warehouse.gram_reader import HASHES, GramReader, OpenedGrams, open_grams
from fleet_slip.warehouse.warehouse import Warehouse

# Division of a cohort into folds.

FoldKey = Literal["drive", "vehicle", "track", "day", "mass", "adhesion", "speed", "part"]

FOLD_KEYS: dict[str, str] = {
    "drive": "trip",
    "vehicle": "vehicle_id",
    "track": "track",
    "day": "day",
    "mass": "mass_kg",
    "adhesion": "adhesion",
    "speed": "speed_factor",
    "part": "part",
}
"""Column of each fold key. The drives of a trip are segments of one, and share a fold."""

BANDS: FoldKey = "speed"
"""Folds are bands of speed, so that a model is tested on speeds that it was not trained on."""

PARTS: FoldKey = "part"
"""Folds are blocks of time, into which the feature set divides drives."""


EACH: Literal["each"] = "each"
"""Instead of a number of folds: each value of the key is a fold."""

FoldCount: TypeAlias = Annotated[int, Field(ge=2, le=1000)] | Literal["each"]

MAX_FOLDS = 10_000
"""Limit for `EACH`: each fold is an exact fit of every model."""


class Folding(Config):
    """Key and number of the folds of a cohort."""

    by: FoldKey = "drive"
    count: FoldCount = 5


def make_folding(by: FoldKey, count: int | str | None, usual: FoldCount) -> Folding:
    """Return a folding, by default of `usual` folds or all blocks. Raises `UsageError`."""
    if count is None:
        count = EACH if by == PARTS else usual
    try:
        return Folding.model_validate({"by": by, "count": count if count == EACH else int(count)})
    except ValueError:
        raise UsageError(
            f"folds = {count}: choose a number from 2 to 1000, or each: every {by} a fold of its "
            "own."
        ) from None


def require_blocks(catalog: Catalog, feature_set: str, by: str) -> None:
    """Raise `QuestionError` if folds need blocks and the feature set does not have any."""
    if by == PARTS and not catalog.feature_set(feature_set).block_ticks:
        divided = ", ".join(name for name, entry in catalog.sets.items() if entry.block_ticks)
        raise QuestionError(
            f"the feature set {feature_set} does not divide the rows of a drive. Feature sets with "
            f"blocks of time: {divided}."
        )


def assign_folds(values: Sequence[Any], by: str, count: FoldCount) -> FoldAssignment:
    """Assign Gram rows to folds by the values of a key. Raises `DataError` for one or too many."""
    if by == "drive" and len(set(values)) == 1:
        raise DataError(
            "cross-validation needs at least two folds, and the cohort is one drive, or one trip: "
            f"drives of a car less than {LONGEST_PAUSE_S // 60} minutes apart. Add logs, or hold "
            "out parts of the time: fleet-slip gram --features blocks, then fleet-slip select "
            "--features blocks --group-by part --save LIST.toml"
        )
    if count == EACH:
        if (number := len(set(values))) > MAX_FOLDS:
            raise DataError(
                f"the cohort has {number:,}, and at most {MAX_FOLDS:,} can be folds of their own. "
                f"Fold by another key than {by}, or say how many folds."
            )
        return by_value(values)
    if by == BANDS:
        return by_value(values, bands=count)
    if len(set(values)) > count:
        return by_hash([str(value) for value in values], count)
    return by_value(values)


# Cohorts.


def hash_names(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car, see `Hashes`."""
    starts = b"".join([sha256(text.encode("utf-8")).digest()[:8] for text in ids.to_pylist()])
    return np.frombuffer(starts, dtype=">u8").astype(np.uint64)


def remark_left_out(drives: int, feature_set: str) -> Iterator[Remark]:
    """Yield a remark on drives without Gram rows of a feature set: their cars sent no log."""
    if drives:
        yield Remark(
            f"{pluralize(drives, 'drive')} without a log left out: cars send Gram rows of the "
            f"logged signals, not of the feature set {feature_set}."
        )


@dataclass(frozen=True)
class CompleteCases:
    """Drives of a cohort that contain all given signals: a Gram row and metadata for each."""

    table: GramTable
    drives: pa.Table


@dataclass(frozen=True, kw_only=True)
class Cohort:
    """Gram rows of the drives that satisfy a predicate.

    A drive has several rows if a signal is missing in some of its log rows, or if its feature set
    divides drives into blocks.

    Attributes
    ----------
    catalog
        Definitions of the columns.
    predicate
        SQL predicate on the view `drives`.
    logs_version, grams_version, feature_set
        The data that were read.
    left_out
        Number of drives without Gram rows of the feature set, since their cars sent no log.
    drives
        Metadata of each Gram row: drive, car, signals, number of rows.
    tables
        The Gram rows in the order of `drives`, by signals; empty if only `sums` were read.
    sums, folding
        The Gram of each fold, and the division into folds; None if Gram rows were read.
    source
        Warehouse or reader of the Gram rows.
    prior, weight
        Gram rows of simulated drives in the training set of every fold, and the weight of
        their rows. Rows of the cohort have the weight 1.
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
        """Number of log rows."""
        return int(pc.sum(self.drives["n"]).as_py())

    @cached_property
    def drive_numbers(self) -> IntArray:
        """Number of the drive of each Gram row, from 0."""
        indices = pc.dictionary_encode(self.drives["drive_id"].combine_chunks()).indices
        return np.asarray(indices.to_numpy(), dtype=np.int64)

    @property
    def drive_count(self) -> int:
        """Number of drives."""
        return int(pc.count_distinct(self.drives["drive_hash"]).as_py())

    @property
    def inputs(self) -> tuple[str, ...]:
        """Candidate inputs of a search: columns that the drives, and the prior, contain."""
        present = {
            name for signals in _distinct_signals(self.drives) for name in signals.split(",")
        }
        if self.prior is not None:
            present &= set(self.prior.inputs)
        return tuple(n for n in self.catalog.search_inputs(self.feature_set) if n in present)

    def gram_condition(self, inputs: Sequence[str]) -> str:
        """Return the SQL predicate on the view `grams` for the training rows of a model."""
        catalog, columns = self.catalog, self.catalog.calibrated
        stored = dict.fromkeys(columns[name].of if name in columns else name for name in inputs)
        names = ", ".join(f"'{name}'" for name in [*stored, catalog.signals.label])
        return (
            f"feature_set = '{catalog.identity(self.feature_set)}' AND {self.predicate.sql} AND "
            f"list_has_all(string_split(signals, ','), [{names}])"
        )

    def hash_drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the sorted hashes of the drives that contain all given signals."""
        hashes: Hashes = np.unique(_rows_with(self.drives, signals)["drive_hash"].to_numpy())
        return hashes

    def count_vehicles_with(self, signals: Collection[str]) -> int:
        """Return the number of cars whose drives contain all given signals."""
        return int(pc.count_distinct(_rows_with(self.drives, signals)["vehicle_hash"]).as_py())

    def count_onboard_with(self, signals: Collection[str] = ()) -> int:
        """Return the number of drives without a log that contain all given signals."""
        rows = _rows_with(self.drives, signals)
        onboard = rows.filter(pc.equal(rows["source"].cast(pa.string()), RECEIVED))
        return int(pc.count_distinct(onboard["drive_hash"]).as_py())

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the cohort into folds by a key of `FOLD_KEYS`.

        Each value of the key is a fold; more than `count` values are hashed into `count` folds,
        unless `count` is `EACH`. `speed` makes bands, `part` the blocks of the feature set. Raises
        `QuestionError` if the feature set has no blocks. Reads Gram rows again if only sums of
        other folds were read.
        """
        folding = Folding(by=by, count=count)
        if self.sums is not None and folding == self.folding:
            folds = self.sums
        elif self.sums is not None and self.source is not None:
            cohort = load_cohort(self.source, self.predicate, self.feature_set, folding)
            folds = cohort.folds(by, count)
        else:
            require_blocks(self.catalog, self.feature_set, by)
            values = self.drives[FOLD_KEYS[by]].to_pylist()
            assignment = assign_folds(values, by, count)
            folds = CohortFolds.from_tables(self.tables, assignment, self.drive_numbers)
        if self.prior is None:
            return folds
        auxiliary = tuple(table.total() for table in self.prior.tables)
        return replace(folds, auxiliary=auxiliary, weight=self.weight)

    def complete_cases(self, inputs: Sequence[str]) -> CompleteCases:
        """Return the drives that contain the label and all inputs. Raises `DataError` for none."""
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

    def filter(self, mask: BoolArray) -> "Cohort":
        """Return the cohort with the Gram rows that a mask selects."""
        masks = self._split(mask)
        tables = [table.take(m) for table, m in zip(self.tables, masks, strict=True) if m.any()]
        return replace(self, tables=tuple(tables), drives=self.drives.filter(pa.array(mask)))

    def weighted(self, weights: IntArray) -> "Cohort":
        """Return the cohort with its Gram rows times integer weights.

        The weight of the prior is `FULL_WEIGHT`. Rows of weight zero are dropped.
        """
        cohort = self.filter(weights > 0)
        factors = cohort._split(weights[weights > 0])
        prior = self.prior
        if prior is not None:
            prior = prior.weighted(np.full(len(prior.drives), FULL_WEIGHT))
        tables = tuple(weighted(*pair) for pair in zip(cohort.tables, factors, strict=True))
        return replace(cohort, tables=tables, prior=prior)

    def _split(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Split values of all Gram rows by table."""
        return np.split(values, np.cumsum([len(table) for table in self.tables])[:-1])


def _distinct_signals(drives: pa.Table) -> list[str]:
    return list(drives["signals"].unique().to_pylist())


def _rows_with(drives: pa.Table, signals: Collection[str]) -> pa.Table:
    """Return the rows whose signals include all given ones."""
    required = set(signals)
    matches = [text for text in _distinct_signals(drives) if required <= set(text.split(","))]
    return drives.filter(pc.is_in(drives["signals"], pa.array(matches, pa.string())))


def load_cohort(
    source: Warehouse | GramReader,
    predicate: str | Predicate = TRAINING_DRIVES,
    feature_set: str = PLAIN,
    folding: Folding | None = None,
) -> Cohort:
    """Read the Gram rows of the drives that satisfy a predicate.

    With a `folding` only the sum of each fold is read, which takes little memory. Raises
    `QuestionError` for an invalid predicate, `DataError` if no drive satisfies it, for a single
    fold, or if the feature set was not computed for all logs, and `RefusedError` for drives of
    evaluation scenarios.
    """
    catalog = source.catalog
    predicate = parse_cohort(catalog.signals, predicate)
    if folding is not None:
        require_blocks(catalog, feature_set, folding.by)
    with open_grams(source, feature_set, predicate) as opened:
        if folding is None:
            rows = opened.rows(predicate)
            require_training(rows["source"].unique().to_pylist(), predicate)
            content = _expand_rows(opened, rows)
            if not content["tables"]:  # no row, or none with changes
                raise empty_cohort_error(opened, predicate)
        else:
            names, fold_of = _find_folds(opened, folding, predicate)
            grams, drives = _add_up(opened, predicate, names, fold_of)
            sums = _used_folds(names, grams, drives)
            content = {"drives": drives, "sums": sums, "folding": folding}
        return Cohort(
            catalog=catalog,
            predicate=predicate,
            logs_version=opened.logs_version,
            grams_version=opened.grams_version,
            feature_set=catalog.name_of(opened.identity),
            left_out=opened.count_left_out(predicate),
            source=source,
            **content,
        )


def _expand_rows(opened: OpenedGrams, rows: pa.Table) -> dict[str, Any]:
    expansion = expansion_of(opened)
    groups = list(expansion.tables(rows))
    metadata = rows.drop_columns(["sums", "products", "signals"])
    # Rows with different calibrated columns are in different tables; the metadata follow them.
    drives = [_with_signals(metadata.filter(pa.array(mask)), names) for names, _, mask in groups]
    tables = tuple(table for _, table, _ in groups)
    return {"tables": tables, "drives": pa.concat_tables(drives) if drives else metadata}


def with_gram_rows(cohort: Cohort, rows: pa.Table) -> Cohort:
    """Return a cohort with other Gram rows, such as those of segments of its drives.

    `rows` have the columns of `Cohort.drives` and `sums`, `products` and `signals`, and are sorted
    by signals.
    """
    if cohort.source is None:
        raise ValueError("the cohort has no source")
    with open_grams(cohort.source, cohort.feature_set, cohort.predicate) as opened:
        return replace(cohort, **_expand_rows(opened, rows))


def _with_signals(rows: pa.Table, signals: str) -> pa.Table:
    """Append a column with the same signals in all rows, as a dictionary: the text may be long."""
    column = pa.DictionaryArray.from_arrays(np.zeros(len(rows), dtype=np.int32), [signals])
    return rows.append_column("signals", column)


def require_training(sources: Iterable[str], predicate: Predicate) -> None:
    """Raise `RefusedError` if the drives of a predicate include evaluation scenarios."""
    if SCENARIO in sources:
        raise RefusedError(
            f"the cohort {predicate.quoted} has drives of evaluation scenarios, which no model "
            f"may be trained on. Add to the predicate: AND {TRAINING_DRIVES}"
        )


def empty_cohort_error(opened: OpenedGrams, predicate: Predicate) -> DataError:
    """Return the error for a predicate that selects no drive, with the reason."""
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
    return DataError(
        f"no drive matches the cohort predicate {predicate.quoted}. See the drives with: "
        'fleet-slip sql "FROM drives"; those with faulty sensors with: fleet-slip quality'
    )


# Sums of a cohort over its folds, from Gram rows read batch by batch.

FoldOf = Callable[[pa.RecordBatch], IntArray]
"""Function that returns the fold of each Gram row from its metadata."""


def _add_up(
    opened: OpenedGrams, predicate: Predicate, names: Sequence[object], fold_of: FoldOf
) -> tuple[dict[str, list[Gram]], pa.Table]:
    """Return the exact sums of Gram rows by signals and fold, and the metadata of the rows."""
    expansion = expansion_of(opened)
    grams: dict[str, list[Gram]] = {}
    metadata: list[pa.Table] = []
    for batch in opened.batches(predicate, *HASHES):
        require_training(batch["source"].unique().to_pylist(), predicate)
        folds = fold_of(batch)
        rows = pa.table({name: batch[name] for name in ("n", "source", *HASHES[:2])})
        rows = rows.append_column("fold", pa.array(folds))
        for signals, table, mask in expansion.tables(batch):
            totals, before = table.totals(folds[mask], len(names)), grams.get(signals)
            grams[signals] = list(map(Gram.__add__, before, totals)) if before else totals
            # The filter copies: a column of the batch would keep the whole batch in memory.
            metadata.append(_with_signals(rows.filter(pa.array(mask)), signals))
    if not grams:
        raise empty_cohort_error(opened, predicate)
    return grams, pa.concat_tables(metadata)


def _find_folds(
    opened: OpenedGrams, folding: Folding, predicate: Predicate
) -> tuple[Sequence[str], FoldOf]:
    """Return the names of the folds, and the function that finds the fold of a Gram row."""
    key = FOLD_KEYS[folding.by]
    is_hashable = folding.by in ("drive", "vehicle") and folding.count != EACH
    values = opened.values_of(key, predicate, int(folding.count) + 1 if is_hashable else None)
    if is_hashable and len(values) > (count := int(folding.count)):
        hash_column = key.removesuffix("_id") + "_hash"
        names = [str(fold + 1) for fold in range(count)]
        return names, lambda rows: (rows[hash_column].to_numpy() % count).astype(np.int64)
    if not len(values):
        raise empty_cohort_error(opened, predicate)
    assignment = assign_folds(values.to_pylist(), folding.by, folding.count)
    return assignment.names, lambda rows: assignment.fold[_index_in(values, rows[key])]


def _index_in(values: pa.Array, column: pa.Array) -> IntArray:
    """Return the position of each value of a column in `values`."""
    return np.asarray(pc.index_in(column.cast(values.type), value_set=values))


def _used_folds(
    names: Sequence[str], grams: dict[str, list[Gram]], drives: pa.Table
) -> CohortFolds:
    """Return the folds that contain drives. Raises `DataError` for a single one."""
    order = sorted(grams)
    used = [fold for fold in range(len(names)) if any(grams[key][fold].n for key in order)]
    if len(used) < 2:
        raise DataError(
            "cross-validation needs at least two folds, and the cohort has one: "
            f"{names[used[0]]}. Widen the cohort, or fold by another key."
        )

    @cache
    def count_drives(tables: tuple[int, ...]) -> int:
        mask = pc.is_in(drives["signals"], pa.array([order[table] for table in tables]))
        return int(pc.count_distinct(drives["drive_hash"].filter(mask)).as_py())

    return CohortFolds(
        tuple(names[fold] for fold in used),
        tuple(tuple(grams[key][fold] for fold in used) for key in order),
        lambda tables: count_drives(tuple(tables)),
    )


@dataclass(frozen=True)
class DailySums:
    """Gram and number of drives of each day; `left_out` as in `Cohort`."""

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
    """Add up the Gram rows with label and inputs by day. Raises like `load_cohort`."""
    signals = (*inputs, source.catalog.signals.label)
    predicate = parse_cohort(source.catalog.signals, predicate)
    with open_grams(source, feature_set, predicate) as opened:
        values = opened.values_of("day", predicate).sort()
        days: list[date] = values.to_pylist()
        sums, rows = _add_up(opened, predicate, days, lambda rows: _index_in(values, rows["day"]))
        left_out = opened.count_left_out(predicate)
    complete = [grams for text, grams in sums.items() if set(signals) <= set(text.split(","))]
    if not complete:
        raise missing_signals_error(signals)
    totals = [
        sum((grams[day].restrict(signals) for grams in complete), Gram.zero(signals))
        for day in range(len(days))
    ]
    first_days = _rows_with(rows, signals).group_by("drive_hash").aggregate([("fold", "min")])
    drives = np.bincount(first_days["fold_min"].to_numpy(), minlength=len(days)).tolist()
    used = [day for day, gram in enumerate(totals) if gram.n]
    return DailySums(
        tuple(days[day] for day in used),
        tuple(totals[day] for day in used),
        tuple(drives[day] for day in used),
        left_out,
    )


def clustered_moments(cases: CompleteCases, *, intercept: bool = True) -> DriveMoments:
    """Return the moments of independent clusters: the cars, or for one car its trips.

    Without an intercept moments are about zero.
    """
    table = cases.table if intercept else cases.table.about_origin()
    cars = cases.drives["vehicle_id"].to_pylist()
    unit: ClusterUnit = "vehicle" if len(set(cars)) > 1 else "drive"
    keys = cars if unit == "vehicle" else cases.drives["trip"].to_pylist()
    return DriveMoments.from_table(table, np.unique(keys, return_inverse=True)[1], unit)


# Integer weights of drives: Gram rows times a weight keep every sum exact.
#
# Weights are multiples of 1 / `FULL_WEIGHT`, a power of two. Robust weights are lower for drives
# whose error is far above that of the median drive, such as drives with a lost label or signal.

FULL_WEIGHT = 16
"""Weight of a usual drive."""
USUAL_ERRORS = 3.0
"""Error of a drive over that of the median drive, beyond which its weight is lower."""
MAX_LOST_SHARE = 0.1
"""Maximum share of the weight of all rows that outliers lose."""
MAX_ROUNDS = 50


@dataclass(frozen=True)
class DownweightedDrive(Record):
    """A drive with a robust weight below 1.

    Attributes
    ----------
    weight
        From 0 to 1.
    times
        Root mean square of its residuals over that of the median drive.
    """

    DOCUMENT = "weight times"

    weight: float
    times: float

    @property
    def reason(self) -> str:
        """Explanation for the user."""
        return (
            f"its error is {self.times:.1f} times that of the median drive: robust "
            f"gives it the weight {self.weight:.2f}"
        )


@dataclass(frozen=True)
class DriveWeights:
    """Integer weight of each drive, and `DownweightedDrive.times`; both of shape (drives,)."""

    weights: IntArray
    times: FloatArray

    def drive(self, number: int) -> DownweightedDrive:
        """Return weight and error of a drive."""
        return DownweightedDrive(
            float(self.weights[number]) / FULL_WEIGHT, float(self.times[number])
        )


def robust_weights(drives: DriveMoments) -> DriveWeights:
    """Return weights min(1, c median rms / rms)^2 of drives, by reweighted least squares.

    `drives` are the moments of the inputs and the label, which is last. c is `USUAL_ERRORS`, or the
    lowest multiple of it by powers of 1.25 that takes at most `MAX_LOST_SHARE` of the weight.
    """
    moments, rows, limit = drives.moments, drives.moments[:, 0, 0], USUAL_ERRORS
    result = _reweight(moments, rows, limit)
    while float(rows @ (FULL_WEIGHT - result.weights)) > MAX_LOST_SHARE * FULL_WEIGHT * float(
        rows.sum()
    ):
        limit *= 1.25
        result = _reweight(moments, rows, limit)
    return result


def age_weights(days: Sequence[date], half_life_days: int) -> IntArray:
    """Return weights of drives that halve with each half-life of age before the newest day."""
    age = np.array([(max(days) - day).days for day in days])
    return np.rint(FULL_WEIGHT * 0.5 ** (age / half_life_days)).astype(np.int64)


def weighted(table: GramTable, weights: IntArray) -> GramTable:
    """Return Gram rows times integer weights, exactly; beyond 62 bits as Python integers."""
    largest = np.abs(table.products.astype(np.float64)).max(initial=0) * weights.max(initial=0)
    kind = np.dtype(object) if largest >= 2.0**62 else np.dtype(np.int64)
    n, sums, products = (values.astype(kind) for values in (table.n, table.sums, table.products))
    column = weights[:, None]
    return GramTable(table.signals, n * weights, sums * column, products * column)


def _reweight(moments: FloatArray, rows: FloatArray, limit: float) -> DriveWeights:
    """Fit and weight in turn until no weight changes; the label is the last of the moments."""
    weights = np.full(len(moments), FULL_WEIGHT, dtype=np.int64)
    for _ in range(MAX_ROUNDS):
        total = np.einsum("d,dij->ij", weights.astype(np.float64), moments)
        slopes = np.linalg.pinv(total[:-1, :-1], rcond=1e-13, hermitian=True) @ total[:-1, -1]
        error = np.append(slopes, -1.0)
        squares = np.maximum(np.einsum("i,dij,j->d", error, moments, error), 0.0) / rows
        if not (median := float(np.median(squares))):
            return DriveWeights(
                np.full(len(moments), FULL_WEIGHT, dtype=np.int64), np.ones(len(moments))
            )
        times = np.sqrt(squares / median)
        update = np.rint(FULL_WEIGHT * (limit / np.maximum(times, limit)) ** 2)
        if np.array_equal(update, weights):
            break
        weights = update.astype(np.int64)
    return DriveWeights(weights, times)
