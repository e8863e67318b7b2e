"""Folds of drives, by the SHA-256 of their trips modulo the number of folds, and cross-validation.

The fold depends on the drive only, so that models of different days share a split. Sizes vary by
chance; empty folds are dropped.
"""

import math
import operator
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.base import Record, hash_fold
from fleet_slip.errors import DataError
from fleet_slip.regression import exact
from fleet_slip.regression.gram import Gram, GramTable, missing_signals_error, require_signals
from fleet_slip.regression.least_squares import LinearModel, Scales, condition_number, fit


@dataclass(frozen=True)
class FoldAssignment:
    """The fold 0..len(names)-1 of each drive, shape (drives,), and the names of the folds."""

    fold: IntArray
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        if len(self.names) < 2:
            raise DataError(
                "cross-validation needs at least two folds, and the cohort has one: "
                f"{', '.join(self.names) or 'no drives'}. Widen the cohort, or fold by another key."
            )


def by_hash(keys: Sequence[str], count: int) -> FoldAssignment:
    """Assign drives to folds by the hash of a key.

    Parameters
    ----------
    keys : sequence of str, shape (drives,)
        Trip, vehicle or circuit of each drive.
    count : int
        Number of folds. Empty folds are dropped.

    Returns
    -------
    FoldAssignment

    Raises
    ------
    DataError
        If fewer than two folds have drives.
    """
    numbers = [hash_fold(key, count) for key in keys]
    used = sorted(set(numbers))
    fold = np.searchsorted(used, numbers).astype(np.int64)
    return FoldAssignment(fold, tuple(str(number + 1) for number in used))


def by_value(values: Sequence[Any], bands: int | None = None) -> FoldAssignment:
    """Make one fold of each distinct value, or of each band of values.

    Bands have about as many distinct values each. They depend on the cohort, unlike other folds.

    Parameters
    ----------
    values : sequence, shape (drives,)
    bands : int, optional
        Maximum number of bands. Default: each value is a fold.

    Returns
    -------
    FoldAssignment

    Raises
    ------
    DataError
        If a value is missing, or all are equal.
    """
    if any(value is None for value in values):
        raise DataError(
            "a drive has no value of the column to fold by: fold by another, or leave such drives "
            "out of the cohort."
        )
    distinct = sorted(set(values))
    folds = np.array_split(np.arange(len(distinct)), min(bands or len(distinct), len(distinct)))
    number = {distinct[place]: i for i, members in enumerate(folds) for place in members}
    fold = np.array([number[value] for value in values], dtype=np.int64)
    if len(folds) == len(distinct):
        return FoldAssignment(fold, tuple(map(str, distinct)))
    names = tuple(f"{distinct[members[0]]} to {distinct[members[-1]]}" for members in folds)
    return FoldAssignment(fold, names)


@dataclass(frozen=True)
class Folds:
    """One Gram per fold, with names and number of drives; rows `auxiliary` are always trained on.

    These have an intercept of their own: they contribute products about the means only. Without
    `has_intercept` training Grams are about the origin.
    """

    grams: tuple[Gram, ...]
    names: tuple[str, ...]
    drives: int
    auxiliary: Gram | None = None
    weight: Fraction = Fraction(1)
    has_intercept: bool = True

    @property
    def total(self) -> Gram:
        """The Gram of all training rows, with integer weights."""
        return self._about(self._weighted[1])

    def _about(self, training: Gram) -> Gram:
        return training if self.has_intercept else training.about_origin()

    @cached_property
    def _weighted(self) -> tuple[int, Gram]:
        """The weight of each row of the folds that makes all weights integers, and the sum."""
        total = sum(self.grams[1:], self.grams[0])
        if self.auxiliary is None or not self.weight:
            return 1, total
        factor, divisor = (self.weight / self.auxiliary.n).as_integer_ratio()
        return divisor, total.scaled(divisor) + self.auxiliary.centered().scaled(factor)

    def splits(self) -> Iterator[tuple[Gram, Gram]]:
        """Yield the training Gram and the test Gram of each fold."""
        row_weight, total = self._weighted
        for fold in self.grams:
            yield self._about(total - fold.scaled(row_weight)), fold


@dataclass(frozen=True)
class CohortFolds:
    """The folds of a cohort whose drives may have different signals: `tables` of Grams by set.

    `count_drives` returns the number of drives with rows in some tables, given by index; for
    `auxiliary`, `weight` and `has_intercept` see `Folds`.
    """

    names: tuple[str, ...]
    tables: tuple[tuple[Gram, ...], ...]
    count_drives: Callable[[Sequence[int]], int]
    auxiliary: tuple[Gram, ...] = ()
    weight: Fraction = Fraction(1)
    has_intercept: bool = True

    @classmethod
    def from_tables(
        cls, tables: Sequence[GramTable], assignment: FoldAssignment, drives: IntArray | None = None
    ) -> "CohortFolds":
        """Sum the Gram rows of each fold; `drives` numbers their drives, by default one per row."""
        sizes = [len(table) for table in tables]
        if sum(sizes) != len(assignment.fold):
            raise ValueError("the assignment is not of these drives")
        stops = np.cumsum(sizes)[:-1]
        parts = np.split(assignment.fold, stops)
        numbers = np.arange(sum(sizes)) if drives is None else drives
        grams = tuple(
            tuple(table.totals(fold, len(assignment.names)))
            for table, fold in zip(tables, parts, strict=True)
        )
        drives_of_table = np.split(numbers, stops)

        def count_drives(chosen: Sequence[int]) -> int:
            rows_of_drive = np.bincount(np.concatenate([drives_of_table[i] for i in chosen]))
            return int(np.count_nonzero(rows_of_drive))

        return cls(assignment.names, grams, count_drives)

    def tables_with(self, signals: Collection[str]) -> tuple[int, ...]:
        """Return the positions of the tables whose rows have all signals."""
        needed = set(signals)
        return tuple(i for i, grams in enumerate(self.tables) if needed.issubset(grams[0].signals))

    def with_signals(self, signals: Collection[str]) -> "CohortFolds":
        """Return the same folds of the tables whose rows have all signals."""
        positions = self.tables_with(signals)
        return replace(
            self,
            tables=tuple(self.tables[i] for i in positions),
            count_drives=lambda tables: self.count_drives([positions[i] for i in tables]),
        )

    def complete_cases(self, inputs: Sequence[str], label: str) -> Folds:
        """Return the folds of drives that have the label and all the inputs; skip empty folds.

        Raises `DataError` if fewer than two folds have such rows.
        """
        signals = (*inputs, label)
        complete = self.tables_with(signals)
        if not complete:
            available = sorted({name for grams in self.tables for name in grams[0].signals})
            require_signals(available, signals)
            raise missing_signals_error(signals)
        sums = (
            sum((self.tables[i][f].restrict(signals) for i in complete), Gram.zero(signals))
            for f in range(len(self.names))
        )
        folds = {name: gram for name, gram in zip(self.names, sums, strict=True) if gram.n}
        if len(folds) < 2:
            raise DataError(
                f"only fold {', '.join(folds) or 'none'} has rows with all of "
                f"{', '.join(signals)}. Choose another key to fold by, or fewer signals."
            )
        matching = [
            gram.restrict(signals) for gram in self.auxiliary if set(signals) <= set(gram.signals)
        ]
        auxiliary = sum(matching[1:], matching[0]) if matching else None
        grams, names, drives = tuple(folds.values()), tuple(folds), self.count_drives(complete)
        return Folds(grams, names, drives, auxiliary, self.weight, self.has_intercept)


# Accuracy of predictions from exact sums of predictions and labels.


@dataclass(frozen=True)
class ErrorSums:
    """Sums over n rows of a prediction p, a label y and their products; they add over folds.

    `null` is the sum of (y - m)^2, with m the mean label of the training rows.
    """

    n: int
    p: Fraction
    y: Fraction
    pp: Fraction
    py: Fraction
    yy: Fraction
    null: Fraction

    def __add__(self, other: "ErrorSums") -> "ErrorSums":
        return ErrorSums(*map(operator.add, vars(self).values(), vars(other).values()))

    @property
    def squared_error(self) -> Fraction:
        """Sum of (p - y)^2."""
        return self.pp - 2 * self.py + self.yy

    @property
    def signed_r_squared(self) -> Fraction:
        """Squared correlation with the correlation's sign: ranks models without rounding."""
        covariance = self.py - self.p * self.y / self.n
        variances = (self.pp - self.p**2 / self.n) * (self.yy - self.y**2 / self.n)
        if variances <= 0:
            return Fraction(0)
        return covariance * abs(covariance) / variances

    def figures(self, unit: Fraction) -> "Figures":
        """Return the figures, each rounded once.

        Parameters
        ----------
        unit : Fraction
            Physical value of one count of the label, in rad.

        Returns
        -------
        Figures
        """
        bias = (self.p - self.y) / self.n
        spread = self.squared_error - self.n * bias**2
        square = self.signed_r_squared
        return Figures(
            rows=self.n,
            correlation=math.copysign(exact.sqrt(abs(square)), square),
            rmse=exact.sqrt(self.squared_error / self.n * unit**2),
            error_mean=float(bias * unit),
            error_std=exact.sqrt(spread / (self.n - 1) * unit**2) if self.n > 1 else 0.0,
            relative_rmse=exact.sqrt(self.squared_error / self.null) if self.null else math.inf,
        )


@dataclass(frozen=True)
class Figures(Record):
    """Accuracy of a model on rows that it was not fitted on, in units of the label (rad).

    Attributes
    ----------
    rows : int
    correlation : float
        Of prediction and label, as in Table I; 0 if one of them is constant.
    rmse : float
    error_mean, error_std : float
        Of prediction minus label, as in Table II.
    relative_rmse : float
        RMSE over that of the training rows' mean as prediction.
    """

    DOCUMENT = "rows correlation rmse_deg error_mean_deg error_std_deg relative_rmse"

    rows: int
    correlation: float
    rmse: float
    error_mean: float
    error_std: float
    relative_rmse: float

    @property
    def rmse_deg(self) -> float:
        """Root mean square error in degrees."""
        return math.degrees(self.rmse)

    @property
    def error_mean_deg(self) -> float:
        """Mean error in degrees."""
        return math.degrees(self.error_mean)

    @property
    def error_std_deg(self) -> float:
        """Standard deviation of the error in degrees."""
        return math.degrees(self.error_std)


def error_sums(model: LinearModel, gram: Gram, training_mean: Fraction | None = None) -> ErrorSums:
    """Return the error sums of a model over the rows of a Gram, exactly.

    The sum of squared errors is v'Gv, with v = (coefficients, -1).

    Parameters
    ----------
    model : LinearModel
        In counts.
    gram : Gram
        Test rows, of at least the model's signals and label.
    training_mean : Fraction, optional
        Mean label of the training rows, the reference of `null`. Default: that of the test rows.

    Returns
    -------
    ErrorSums
    """
    part = gram.restrict([*model.signals, model.label])
    k, n = len(model.signals), part.n
    numbers = (model.intercept, *model.coefficients)
    denominator = math.lcm(*(number.denominator for number in numbers))
    # Integers over one common denominator: far cheaper than a sum of fractions.
    w = [int(b * denominator) for b in model.coefficients]
    w0 = int(model.intercept * denominator)
    raw = part.raw()
    linear = sum(b * s for b, s in zip(w, part.sums, strict=False))
    quadratic = sum(b * sum(map(operator.mul, w, row)) for b, row in zip(w, raw, strict=False))
    cross = sum(w[i] * raw[i][k] for i in range(k))
    y, yy = Fraction(part.sums[k]), Fraction(raw[k][k])
    mean = y / n if training_mean is None else training_mean
    return ErrorSums(
        n=n,
        p=Fraction(linear + n * w0, denominator),
        y=y,
        pp=Fraction(quadratic + 2 * w0 * linear + n * w0 * w0, denominator**2),
        py=Fraction(cross + w0 * part.sums[k], denominator),
        yy=yy,
        null=yy - 2 * mean * y + n * mean**2,
    )


# Cross-validation from one Gram per fold: train on the total minus it; pool all sums (Table I).

Procedure = Callable[[Gram], LinearModel]
"""Returns a model of counts for a training Gram. It may select signals."""


@dataclass(frozen=True)
class CrossValidation(Record):
    """Held-out figures of a model, and its fit to all rows.

    Attributes
    ----------
    drives : int
        Number of drives that have all its signals.
    pooled : Figures
        Over the test rows of all folds together, as in Table I.
    folds : tuple of Figures
        Of each fold.
    condition_number : float
        Of the correlation matrix of the inputs, all rows.
    model, counts : LinearModel
        Exact fit to all rows, in physical units and in counts.
    sums : ErrorSums
        Exact pooled sums behind `pooled`, in counts.
    """

    DOCUMENT = (
        "name signals drives *pooled correlation_standard_error=standard_error condition_number "
        "coefficients=model.weights intercept=model.offset folds=named_folds"
    )

    name: str
    signals: tuple[str, ...]
    drives: int
    pooled: Figures
    folds: tuple[Figures, ...] = field(repr=False)
    fold_names: tuple[str, ...] = field(repr=False)
    condition_number: float
    model: LinearModel = field(repr=False)
    counts: LinearModel = field(repr=False)
    sums: ErrorSums = field(repr=False)

    @property
    def correlation(self) -> float:
        """Pooled cross-validated correlation, as in Table I."""
        return self.pooled.correlation

    @property
    def standard_error(self) -> float:
        """Standard error of the correlation over folds: std of the folds' / sqrt(folds)."""
        return error_of_mean([fold.correlation for fold in self.folds])

    @property
    def named_folds(self) -> list[dict[str, Any]]:
        """The figures of each fold with its name, for a JSON document."""
        pairs = zip(self.fold_names, self.folds, strict=True)
        return [{"fold": name, **figures.as_dict()} for name, figures in pairs]


def error_of_mean(values: Sequence[float]) -> float:
    """Return the standard error of the mean of independent values.

    Parameters
    ----------
    values : sequence of float
        Two or more.

    Returns
    -------
    float
    """
    mean = math.fsum(values) / len(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    return math.sqrt(square / (len(values) - 1) / len(values))


def least_squares(inputs: Sequence[str], label: str) -> Procedure:
    """Return the procedure that fits the label on given inputs."""
    return lambda gram: fit(gram, inputs, label).model


def cross_validate(
    name: str, folds: Folds, procedure: Procedure, scales: Scales
) -> CrossValidation:
    """Cross-validate a procedure: k-fold, section III of the paper.

    Parameters
    ----------
    name : str
        Name of the model.
    folds : Folds
    procedure : callable
        Returns a model of counts for a training Gram. It may select signals.
    scales : mapping of str to Fraction
        Physical value of one count of each signal.

    Returns
    -------
    CrossValidation

    Raises
    ------
    DataError
        If a training set determines no model.
    """
    tests = [
        held_out_errors(procedure(training), training, test) for training, test in folds.splits()
    ]
    return assemble(name, folds, tests, procedure(folds.total), scales)


def assemble(
    name: str, folds: Folds, tests: Sequence[ErrorSums], counts: LinearModel, scales: Scales
) -> CrossValidation:
    """Combine the held-out sums of each fold with the model of counts fitted to all rows."""
    pooled = sum(tests[1:], tests[0])
    unit = scales[counts.label]
    return CrossValidation(
        name=name,
        signals=counts.signals,
        drives=folds.drives,
        pooled=pooled.figures(unit),
        folds=tuple(sums.figures(unit) for sums in tests),
        fold_names=folds.names,
        condition_number=condition_number(folds.total, counts.signals),
        model=counts.physical(scales),
        counts=counts,
        sums=pooled,
    )


def held_out_errors(model: LinearModel, training: Gram, test: Gram) -> ErrorSums:
    """Return the error sums, on a test Gram, of a model that was fitted on the training Gram."""
    return error_sums(model, test, Fraction(training.sum(model.label), training.n))
