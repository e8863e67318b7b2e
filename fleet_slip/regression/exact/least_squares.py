"""Ordinary least squares of a Gram, solved exactly and rounded once (equation (4) of the paper)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact import exact_roots
from fleet_slip.regression.exact.elimination import (
    Elimination,
    eliminate,
    solve_by_lifting,
    symmetric_eigenvalues,
)
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.words import number_of

MANY_INPUTS = 40
"""From so many on, lifting is faster than elimination; both give the same fractions."""

Scales = Mapping[str, Fraction]
"""Physical value of one count of each signal: `catalogue()[name].exact_scale`."""


@dataclass(frozen=True)
class LinearModel:
    """label = intercept + sum of coefficient times signal, exactly; of counts, or `physical`."""

    signals: tuple[str, ...]
    label: str
    coefficients: tuple[Fraction, ...] = field(repr=False)  # of thousands of digits
    intercept: Fraction = field(repr=False)

    def physical(self, scales: Scales) -> "LinearModel":
        """Return the model of physical values, from a model of counts."""
        unit = scales[self.label]
        return LinearModel(
            self.signals,
            self.label,
            tuple(
                b * unit / scales[name]
                for name, b in zip(self.signals, self.coefficients, strict=True)
            ),
            self.intercept * unit,
        )

    @property
    def weights(self) -> dict[str, float]:
        """Coefficient of each signal, each rounded once to binary64."""
        return {name: float(b) for name, b in zip(self.signals, self.coefficients, strict=True)}

    @property
    def offset(self) -> float:
        """Intercept, rounded once to binary64."""
        return float(self.intercept)


@dataclass(frozen=True)
class Fit:
    """Exact least-squares fit of a Gram of inputs and label, in counts; `rss` is in counts^2."""

    gram: Gram
    model: LinearModel
    rss: Fraction
    has_intercept: bool = True

    @property
    def size(self) -> int:
        """Number of inputs."""
        return len(self.model.signals)

    @cached_property
    def tss(self) -> Fraction:
        """Sum of squares of the label, about its mean if there is an intercept."""
        y = self.model.label
        square = Fraction(self.gram.product(y, y))
        if not self.has_intercept:
            return square
        return square - Fraction(self.gram.sum(y) ** 2, self.gram.n)

    @property
    def degrees_of_freedom(self) -> int:
        """Rows minus the number of estimated coefficients."""
        return self.gram.n - self.size - int(self.has_intercept)

    @property
    def r_squared(self) -> float:
        """1 - RSS / TSS; 0 for a constant label."""
        return float(1 - self.rss / self.tss) if self.tss else 0.0


def fit(gram: Gram, inputs: Sequence[str], label: str, *, intercept: bool = True) -> Fit:
    """Fit the label by exact least squares. Raises `DataError` that names dependent signals."""
    part = gram.restrict([*inputs, label])
    matrix = moments(part, intercept=intercept)
    if len(inputs) >= MANY_INPUTS and (lifted := _lifted(part, matrix, intercept=intercept)):
        return lifted
    triangle = eliminate(matrix)
    if triangle.singular is not None:
        raise DataError(dependence(part, inputs, intercept=intercept))
    return fit_leading(part, triangle, len(inputs), intercept=intercept)


def fit_leading(gram: Gram, triangle: Elimination, size: int, *, intercept: bool = True) -> Fit:
    """Return the fit of the first `size` inputs of an eliminated Gram (label last)."""
    part = gram.restrict([*gram.signals[:size], gram.signals[-1]])
    return _fit_of(part, *triangle.solve(size), triangle.residual(size), intercept=intercept)


def _lifted(part: Gram, matrix: list[list[int]], *, intercept: bool) -> Fit | None:
    """Return the same fit from p-adic lifting; None if inputs are linearly dependent."""
    right = matrix[-1][:-1]
    solution = solve_by_lifting([row[:-1] for row in matrix[:-1]], right)
    if solution is None:
        return None
    numerators, denominator = solution
    explained = sum(x * b for x, b in zip(numerators, right, strict=True))
    residual = matrix[-1][-1] - Fraction(explained, denominator)
    return _fit_of(part, numerators, denominator, residual, intercept=intercept)


def _fit_of(
    part: Gram, numerators: Sequence[int], denominator: int, residual: Fraction, *, intercept: bool
) -> Fit:
    """Return the fit of a Gram (label last) whose equations have this solution and residual."""
    inputs, label = part.signals[:-1], part.signals[-1]
    coefficients = tuple(Fraction(x, denominator) for x in numerators)
    offset = Fraction(0)
    if intercept:
        explained = sum(x * s for x, s in zip(numerators, part.sums, strict=False))
        offset = Fraction(denominator * part.sums[-1] - explained, denominator * part.n)
    model = LinearModel(inputs, label, coefficients, offset)
    return Fit(part, model, residual / (part.n if intercept else 1), intercept)


def moments(gram: Gram, *, intercept: bool = True) -> list[list[int]]:
    """Return n S about the means, or raw products. Raises `DataError` if there are no rows."""
    if gram.n == 0:
        raise DataError("no rows to fit: choose a cohort with drives that have all signals.")
    return gram.centred() if intercept else gram.raw()


def dependence(gram: Gram, inputs: Sequence[str], *, intercept: bool = True) -> str:
    """Say which inputs are linearly dependent, and how, exactly; empty if none is."""
    independent: list[str] = []
    found = []
    for name in inputs:
        part = gram.restrict([*independent, name])
        triangle = eliminate(moments(part, intercept=intercept))
        if triangle.corners[-1] == 0:
            size = len(independent)
            found.append(_relation(fit_leading(part, triangle, size, intercept=intercept)))
        else:
            independent.append(name)
    if not found:
        return ""
    rows = f" There are only {number_of(gram.n, 'row')}." if gram.n <= len(inputs) else ""
    relations = "; ".join(found)
    return f"the model has no unique solution: {relations}.{rows} Leave out one signal of each."


def _relation(fitted: Fit) -> str:
    model = fitted.model
    terms = {name: b for name, b in zip(model.signals, model.coefficients, strict=True) if b != 0}
    if not terms:
        return f"{model.label} is constant ({model.intercept} counts)"
    text = f"{model.label} is a linear combination of {', '.join(terms)}"
    numbers = [*terms.values(), model.intercept]
    if len(terms) <= 3 and all(b.denominator <= 1000 for b in numbers):
        right = " + ".join(f"{b} {other}" if b != 1 else other for other, b in terms.items())
        constant = f" + {model.intercept}" if model.intercept else ""
        text += f" (in counts: {model.label} = {right}{constant})".replace("+ -", "- ")
    return text


def correlation_matrix(gram: Gram) -> FloatArray:
    """Return all correlations, (k, k), each rounded once; zeros for a constant signal."""
    centred = gram.centred()
    correlations = np.zeros((len(centred), len(centred)))
    for i, row in enumerate(centred):
        for j in range(i + 1):
            correlation = exact_roots.signed_ratio(row[j], row[i] * centred[j][j])
            correlations[i, j] = correlations[j, i] = correlation
    return correlations


def condition_number(gram: Gram, inputs: Sequence[str]) -> float:
    """Return the 2-norm condition number of correlations, within k of the best scaling's."""
    if not inputs:
        return 1.0
    eigenvalues = symmetric_eigenvalues(correlation_matrix(gram.restrict(inputs)))
    smallest, largest = eigenvalues[0], eigenvalues[-1]
    return largest / smallest if smallest > 0 else float("inf")


def through_means(gram: Gram, label: str, slopes: dict[str, Fraction]) -> LinearModel:
    """Return the model with given slopes whose intercept makes the mean error zero."""
    intercept = Fraction(gram.sum(label)) - sum(b * gram.sum(s) for s, b in slopes.items())
    return LinearModel(tuple(slopes), label, tuple(slopes.values()), intercept / gram.n)
