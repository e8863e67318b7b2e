"""WEKA's LinearRegression from a Gram, to compare with what WEKA finds.

The mathematics of WEKA 3.9 as observed. LinearRegression: a small ridge on standardised moments,
removal of signals with a standardised coefficient above 1.5, and an Akaike rule relative to the
first model. The removal is harmful for collinear signals such as four wheel speeds.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import Literal

from fleet_slip.regression import exact as exact_roots
from fleet_slip.regression.figures import error_sums
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel
from fleet_slip.regression.shrinkage import fit_penalised

Selection = Literal["none", "m5", "greedy"]

COLLINEAR = 1.5
"""Standardised coefficients above this are taken for a sign of collinearity."""


def weka_linear_regression(
    gram: Gram,
    inputs: Sequence[str],
    label: str,
    *,
    selection: Selection = "m5",
    drop_collinear: bool = True,
    ridge: Fraction = Fraction(1, 10**8),
) -> LinearModel:
    """Return the model of counts that WEKA's LinearRegression finds.

    `selection` is its option -S (1 none, 0 m5, 2 greedy), `drop_collinear` is off with -C, and
    `ridge` is -R. Raises `DataError` if the moments are singular.
    """
    search = _Search(gram, label, ridge)
    model = search.fit(list(inputs))
    while drop_collinear and model.signals:
        sizes = standardised_size(gram, model)
        largest = max(sizes, key=lambda name: sizes[name])
        if sizes[largest] <= COLLINEAR:
            break
        model = search.fit([name for name in model.signals if name != largest])
    if selection == "none":
        return model
    price = _Akaike(gram, model)
    removals = _smallest if selection == "m5" else _each
    improved = True
    while improved and model.signals:
        candidates = [
            search.fit([name for name in model.signals if name != removed])
            for removed in removals(gram, model)
        ]
        best = min(candidates, key=price)
        improved = price(best) < price(model)
        model = best if improved else model
    return model


class _Search:
    def __init__(self, gram: Gram, label: str, ridge: Fraction) -> None:
        self.gram, self.label, self.ridge = gram, label, ridge

    def fit(self, inputs: list[str]) -> LinearModel:
        penalties = standardised_penalty(self.gram, inputs, self.ridge)
        return fit_penalised(self.gram, inputs, self.label, penalties)


class _Akaike:
    """RSS / RSS_first (n - p_first) + 2 p, with p counting the constant."""

    def __init__(self, gram: Gram, first: LinearModel) -> None:
        self.gram = gram
        self.first_rss = error_sums(first, gram).squared_error
        self.degrees = gram.n - len(first.signals) - 1

    def __call__(self, model: LinearModel) -> Fraction:
        rss = error_sums(model, self.gram).squared_error
        return rss / self.first_rss * self.degrees + 2 * (len(model.signals) + 1)


def _smallest(gram: Gram, model: LinearModel) -> list[str]:
    sizes = standardised_size(gram, model)
    return [min(sizes, key=lambda name: sizes[name])]


def _each(gram: Gram, model: LinearModel) -> list[str]:
    return list(model.signals)


def standardised_penalty(gram: Gram, inputs: Sequence[str], penalty: Fraction) -> list[Fraction]:
    """Return the penalties in counts^2 that equal one on the sample-standardised moments.

    (n - 1) C + penalty I for standard deviations with n - 1 is S + penalty diag(S) / (n - 1).
    """
    matrix = gram.restrict(inputs).centred()
    return [penalty * Fraction(row[i], gram.n * (gram.n - 1)) for i, row in enumerate(matrix)]


def standardised_size(gram: Gram, model: LinearModel) -> dict[str, float]:
    """Return |b_j| s_j / s_y of each signal, s the standard deviations."""
    matrix = gram.restrict([*model.signals, model.label]).centred()
    return {
        name: exact_roots.sqrt(b * b * matrix[i][i] / matrix[-1][-1])
        for i, (name, b) in enumerate(zip(model.signals, model.coefficients, strict=True))
    }
