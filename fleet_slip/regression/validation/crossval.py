"""Cross-validation from one Gram a fold: train on the total minus it; pool all sums (Table I)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from fleet_slip.regression.exact.figures import ErrorSums, Figures, error_sums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import LinearModel, Scales, condition_number, fit
from fleet_slip.regression.validation.folds import CohortFolds, Folds

Procedure = Callable[[Gram], LinearModel]
"""Makes a model of counts from a training Gram: any fit, with any selection inside."""


@dataclass(frozen=True)
class CrossValidation:
    """A model's figures on rows that it was not fitted on, and its fit to all rows.

    Attributes:
        drives: number of drives it used: those that have all its signals.
        pooled, folds: figures over all folds' test rows together, and of each fold.
        condition_number: of the correlation matrix of the inputs, all rows.
        model, counts: exact fit to all rows, in physical units and in counts.
        sums: exact pooled sums behind `pooled`, in counts.
    """

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

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "name": self.name,
            "signals": list(self.signals),
            "drives": self.drives,
            **self.pooled.as_dict(),
            "correlation_standard_error": self.standard_error,
            "condition_number": self.condition_number,
            "coefficients": self.model.weights,
            "intercept": self.model.offset,
            "folds": [
                {"fold": name, **figures.as_dict()}
                for name, figures in zip(self.fold_names, self.folds, strict=True)
            ],
        }


def error_of_mean(values: Sequence[float]) -> float:
    """Return the standard error of the mean of independent values."""
    mean = math.fsum(values) / len(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    return math.sqrt(square / (len(values) - 1) / len(values))


def least_squares(inputs: Sequence[str], label: str, *, intercept: bool = True) -> Procedure:
    """Return the procedure that fits the label on given inputs."""
    return lambda gram: fit(gram, inputs, label, intercept=intercept).model


def cross_validate(
    name: str, folds: Folds, procedure: Procedure, scales: Scales
) -> CrossValidation:
    """Cross-validate a procedure that sees training Grams alone. Raises `DataError`."""
    tests = [
        held_out_errors(procedure(training), training, test) for training, test in folds.splits()
    ]
    return assemble(name, folds, tests, procedure(folds.total), scales)


def assemble(
    name: str, folds: Folds, tests: Sequence[ErrorSums], counts: LinearModel, scales: Scales
) -> CrossValidation:
    """Put together the held-out sums of each fold and the model of counts fitted to all rows."""
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


def cross_validate_inputs(
    name: str,
    cohort: CohortFolds,
    inputs: Sequence[str],
    label: str,
    scales: Scales,
    *,
    intercept: bool = True,
) -> CrossValidation:
    """Cross-validate least squares over all drives that have the inputs. Raises `DataError`."""
    folds = cohort.serving(inputs, label)
    return cross_validate(name, folds, least_squares(inputs, label, intercept=intercept), scales)


def held_out_errors(model: LinearModel, training: Gram, test: Gram) -> ErrorSums:
    """Return the error sums on a test Gram of a model that was fitted on the training Gram."""
    return error_sums(model, test, Fraction(training.sum(model.label), training.n))
