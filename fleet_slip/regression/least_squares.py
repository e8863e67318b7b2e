"""Ordinary least squares of a Gram, solved exactly and rounded once (equation (4) of the paper)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from math import lcm
from types import MappingProxyType
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record, pluralize
from fleet_slip.errors import DataError
from fleet_slip.regression import exact
from fleet_slip.regression.gram import Gram

Scales = Mapping[str, Fraction]
"""Physical value of one count of each signal: `Catalog.input_scales`."""


@dataclass(frozen=True)
class LinearModel(Record):
    """A linear model with exact coefficients: label = intercept + sum of coefficient * signal.

    Attributes
    ----------
    signals : tuple of str
        The k inputs.
    label : str
    coefficients : tuple of Fraction, shape (k,)
        Of counts, or of physical values after `physical`.
    intercept : Fraction
    """

    DOCUMENT = "intercept=offset *weights"

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
    """Exact least-squares fit of a label on inputs.

    Attributes
    ----------
    gram : Gram
        Sums and products of counts of the inputs and the label.
    model : LinearModel
        Coefficients in counts.
    rss : Fraction
        Residual sum of squares in counts^2.
    """

    gram: Gram
    model: LinearModel
    rss: Fraction

    @property
    def has_intercept(self) -> bool:
        """False for moments about the origin."""
        return self.gram.has_mean

    @property
    def size(self) -> int:
        """Number of inputs."""
        return len(self.model.signals)

    @cached_property
    def tss(self) -> Fraction:
        """Sum of squares of the label, about its mean if there is an intercept."""
        y = self.model.label
        return self.gram.product(y, y) - Fraction(self.gram.sum(y) ** 2, self.gram.n)

    @property
    def degrees_of_freedom(self) -> int:
        """Rows minus the number of estimated coefficients."""
        return self.gram.n - self.size - int(self.has_intercept)

    @property
    def r_squared(self) -> float:
        """1 - RSS / TSS; 0 for a constant label."""
        return float(1 - self.rss / self.tss) if self.tss else 0.0


def fit(gram: Gram, inputs: Sequence[str], label: str) -> Fit:
    """Fit a label by ordinary least squares, exactly: equation (4) of the paper.

    Parameters
    ----------
    gram : Gram
        Sums and products of counts, of at least the inputs and the label. About the origin
        (`Gram.about_origin`) the model has no intercept.
    inputs : sequence of str
        Signals to fit on, k of them; none for the mean.
    label : str
        Signal to estimate.

    Returns
    -------
    Fit
        Coefficients in counts, and the residual sum of squares in counts^2.

    Raises
    ------
    DataError
        If the Gram has no rows, or if inputs are linearly dependent. The message names them.
    """
    part = gram.restrict([*inputs, label])
    return fit_moments(part, moments(part))


def fit_moments(part: Gram, matrix: list[list[int]]) -> Fit:
    """Fit the last signal of a Gram on all others.

    Parameters
    ----------
    part : Gram
        The k inputs and the label, which is last.
    matrix : list of list of int, shape (k + 1, k + 1)
        Its `moments`.

    Returns
    -------
    Fit

    Raises
    ------
    DataError
        If inputs are linearly dependent.
    """
    *inputs, label = part.signals
    right = matrix[-1][:-1]
    solution = exact.solve([row[:-1] for row in matrix[:-1]], right)
    if solution is None:
        raise DataError(dependence(part, inputs))
    numerators, denominator = solution
    explained = sum(x * b for x, b in zip(numerators, right, strict=True))
    residual = matrix[-1][-1] - Fraction(explained, denominator)
    predicted = sum(x * s for x, s in zip(numerators, part.sums, strict=False))
    offset = Fraction(denominator * part.sums[-1] - predicted, denominator * part.n)
    coefficients = tuple(Fraction(x, denominator) for x in numerators)
    model = LinearModel(tuple(inputs), label, coefficients, offset)
    return Fit(part, model, residual / part.n)


def moments(gram: Gram) -> list[list[int]]:
    """Return the matrix of the normal equations: n times the products about the means.

    Parameters
    ----------
    gram : Gram
        Of k signals.

    Returns
    -------
    list of list of int, shape (k, k)

    Raises
    ------
    DataError
        If there are no rows.
    """
    if gram.n == 0:
        raise DataError("no rows to fit: choose a cohort with drives that have all signals.")
    return gram.centered_products()


def dependence(gram: Gram, inputs: Sequence[str]) -> str:
    """Describe how inputs depend linearly on each other.

    Parameters
    ----------
    gram : Gram
        Sums and products of counts, of at least the inputs.
    inputs : sequence of str
        Signals in the order in which a dependent one is looked for.

    Returns
    -------
    str
        Sentences for a message; empty if the inputs are independent.

    Raises
    ------
    DataError
        If the Gram has no rows.
    """
    part = gram.restrict(inputs)
    relations = [
        f"{part.signals[column]} is a linear combination of "
        f"{', '.join(part.signals[i] for i in weights)}"
        if weights
        else f"{part.signals[column]} is constant"
        for column, weights in exact.dependent_columns(moments(part)).items()
    ]
    if not relations:
        return ""
    if (more := len(relations) - MAX_RELATIONS) > 0:
        relations = [*relations[:MAX_RELATIONS], f"and {pluralize(more, 'other relation')}"]
    rows = f" There are only {pluralize(gram.n, 'row')}." if gram.n <= len(inputs) else ""
    return (
        f"the model has no unique solution: {'; '.join(relations)}.{rows} Leave out one signal of "
        "each."
    )


MAX_RELATIONS = 3
"""Maximum number of relations in a message."""


def correlation_matrix(gram: Gram) -> FloatArray:
    """Return the correlations of all signals.

    Parameters
    ----------
    gram : Gram
        Of k signals.

    Returns
    -------
    float array, shape (k, k)
        Zero for a constant signal.
    """
    products = np.array(gram.centered_products(), dtype=np.float64)
    lengths = np.sqrt(products.diagonal())
    lengths[lengths == 0] = 1.0
    correlations: FloatArray = products / np.outer(lengths, lengths)
    return correlations


def condition_number(gram: Gram, inputs: Sequence[str]) -> float:
    """Return the 2-norm condition number of the inputs' correlation matrix.

    It is within a factor k of the lowest that any scaling of k inputs reaches (van der Sluis 1969,
    Numerische Mathematik 14:14).

    Parameters
    ----------
    gram : Gram
        Sums and products of counts, of at least the inputs.
    inputs : sequence of str

    Returns
    -------
    float
        1 without inputs; infinity if they are dependent.
    """
    return exact.condition_number(gram.restrict(inputs).centered_products()) if inputs else 1.0


# Relations that hold on average, from sums of products: exact solutions, and influence of drives.
#
# A relation is y = theta_1 x_1 + theta_2 x_2 + ... + noise. Multiplied by instruments z and summed
# up, it gives as many linear equations. Products z x of three columns are often those of two
# others, as (ay/v)(r v) = ay r, so that Gram rows contain them without a column x.

ONE = "1"
"""The constant among the terms."""

Terms = Mapping[str, Mapping[str, Fraction]]
"""Linear combinations of columns by name: the weight of each column."""
Product = tuple[str, str]


@dataclass(frozen=True)
class Relation:
    """A linear relation of terms, y = theta_1 x_1 + theta_2 x_2 + ... + noise, with instruments.

    Attributes
    ----------
    instruments : tuple of str
        Terms z, as many as unknowns.
    products : tuple of tuple of Product
        For each instrument, its products with the terms x of the unknowns.
    response_products : tuple of Product
        For each instrument, its product with y.
    noise : mapping of (int, int) to Product
        Products that noise of unit variance adds, by row and unknown; that of y is -1.
    """

    instruments: tuple[str, ...]
    products: tuple[tuple[Product, ...], ...]
    response_products: tuple[Product, ...]
    noise: Mapping[tuple[int, int], Product] = field(default_factory=dict)

    @classmethod
    def least_squares(
        cls,
        response: str,
        regressors: tuple[str, ...],
        noise: Mapping[tuple[int, int], Product] = MappingProxyType({}),
    ) -> "Relation":
        """Return the relation of a term to others, which are the instruments.

        Parameters
        ----------
        response : str
            The term y.
        by : tuple of str
            The terms x.
        noise : mapping of (int, int) to Product

        Returns
        -------
        Relation
        """
        products = tuple(tuple((a, b) for b in regressors) for a in regressors)
        return cls(regressors, products, tuple((response, a) for a in regressors), noise)

    def system(
        self, sums: Callable[[str, str], Any], variance: Fraction | float
    ) -> list[list[Any]]:
        """Return the linear equations of the unknowns, corrected for noise.

        Parameters
        ----------
        sums : callable
            Returns the sum of products of two terms: fractions, or arrays of drives.
        variance : Fraction or float
            Variance of the noise.

        Returns
        -------
        list of list
            A row for each equation, with its right-hand side last.
        """
        rows = [
            [sums(a, b) for a, b in (*row, response_product)]
            for row, response_product in zip(self.products, self.response_products, strict=True)
        ]
        for (row, column), (a, b) in self.noise.items():
            rows[row][column] = rows[row][column] - variance * sums(a, b)
        return rows


class ExactSums:
    """Sums of products of terms over the rows of a Gram, as fractions."""

    def __init__(self, gram: Gram, terms: Terms) -> None:
        """Sum up the products of terms. Raises `DataError` for a column that the Gram lacks."""
        self._factors = {
            name: lcm(*(weight.denominator for weight in weights.values()))
            for name, weights in terms.items()
        }
        self.gram = gram.combine(
            {
                name: {
                    column: int(weight * self._factors[name]) for column, weight in weights.items()
                }
                for name, weights in terms.items()
            }
        )

    def __call__(self, a: str, b: str) -> Fraction:
        """Return the sum of the products of two terms."""
        if a == ONE:
            a, b = b, a
        if a == ONE:
            return Fraction(self.gram.n)
        if b == ONE:
            return Fraction(self.gram.sum(a), self._factors[a])
        return Fraction(self.gram.product(a, b), self._factors[a] * self._factors[b])

    def mean(self, name: str) -> Fraction:
        """Return a term's mean."""
        return self(name, ONE) / self.gram.n

    def variance(self, name: str) -> Fraction:
        """Return a term's variance."""
        return self(name, name) / self.gram.n - self.mean(name) ** 2

    def residual_variance(self, name: str, inputs: Sequence[str]) -> Fraction | None:
        """Return the residual variance of a term on other terms, None if these are dependent."""
        matrix = self.gram.restrict((*inputs, name)).centered_products()
        inner = exact.determinant([row[:-1] for row in matrix[:-1]])
        if inner == 0:
            return None
        residual = Fraction(exact.determinant(matrix), inner)
        return residual / (self.gram.n * self._factors[name]) ** 2


def influence(
    relation: Relation,
    sums: Callable[[str, str], FloatArray],
    noise: float,
    gradient: Sequence[float],
) -> tuple[FloatArray, FloatArray] | None:
    """Return each drive's influence on a combination of unknowns, and its share of the variance.

    With the equations A_g of a drive, A of all drives, and h = A'^-1 a, a drive moves a'theta by
    h'(y_g - A_g theta); its share of the variance is h'Z_g'Z_g h.

    Parameters
    ----------
    relation : Relation
    sums : callable
        Returns the sums of products of two terms of each drive, shape (drives,).
    noise : float
        Variance of the noise.
    gradient : sequence of float, shape (k,)
        The combination a of the k unknowns.

    Returns
    -------
    tuple of (float array, float array) or None
        Influence and share, each of shape (drives,). None if the equations are singular.
    """
    equations = _stacked(relation.system(sums, noise))
    coefficients, right = equations[:, :, :-1], equations[:, :, -1]
    summed = coefficients.sum(axis=0)
    try:
        unknowns = np.linalg.solve(summed, right.sum(axis=0))
        h = np.linalg.solve(summed.T, np.asarray(gradient))
    except np.linalg.LinAlgError:
        return None
    squares = _stacked([[sums(a, b) for b in relation.instruments] for a in relation.instruments])
    return (right - coefficients @ unknowns) @ h, np.einsum("i,gij,j->g", h, squares, h)


def drive_term_sums(
    moments: FloatArray, columns: Sequence[str], terms: Terms
) -> Callable[[str, str], FloatArray]:
    """Return the sums of products of two terms in each of several drives, in floating point.

    `moments` are those of (1, columns) about zero, shape (drives, k+1, k+1).
    """
    at = {name: i for i, name in enumerate((ONE, *terms))}
    turn = np.zeros((len(at), moments.shape[1]))
    turn[0, 0] = 1.0
    for name, weights in terms.items():
        for column, weight in weights.items():
            turn[at[name], 1 + columns.index(column)] = float(weight)
    sums = turn @ moments @ turn.T
    return lambda a, b: sums[:, at[a], at[b]]


def _stacked(rows: Sequence[Sequence[Any]]) -> FloatArray:
    """Return entries of each drive as one array, shape (drives, rows, columns)."""
    return np.moveaxis(np.array(rows, dtype=np.float64), -1, 0)
