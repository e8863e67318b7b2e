"""Least squares with an added diagonal, S b + Lambda b = S_xy.

A positive Lambda is ridge regression, or the exact minimiser under noise to come, n times its
variance (Bishop 1995); a negative one corrects for noise that is there (Fuller 1987).

What sensor bias and noise do to a model's error, in closed form (the paper's section III-A).

With biases d_j and noise v_j, the prediction changes by b'd + sum b_j v_j: every sum follows.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.exact.elimination import eliminate
from fleet_slip.regression.exact.figures import ErrorSums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import (
    LinearModel,
    Scales,
    moments,
    through_means,
)


def fit_penalised(
    gram: Gram, inputs: Sequence[str], label: str, penalties: Sequence[Fraction]
) -> LinearModel:
    """Solve (S + diag(penalties)) b = S_xy exactly, penalties in counts^2, or `DataError`."""
    part = gram.restrict([*inputs, label])
    common = math.lcm(*(penalty.denominator for penalty in penalties))
    matrix = [[common * entry for entry in row] for row in moments(part)]
    for i, penalty in enumerate(penalties):
        matrix[i][i] += int(part.n * common * penalty)
    triangle = eliminate(matrix)
    if triangle.singular is not None or min(triangle.minors) <= 0:
        at = triangle.singular
        if at is None:
            at = next(i for i, minor in enumerate(triangle.minors) if minor <= 0) - 1
        raise DataError(
            f"the moments stop being positive definite at {inputs[at]}: the assumed noise is more "
            "than the signal holds, or signals are linearly dependent."
        )
    numerators, determinant = triangle.solve(len(inputs))
    slopes = {name: Fraction(x, determinant) for name, x in zip(inputs, numerators, strict=True)}
    return through_means(part, label, slopes)


def fit_noise_matched(
    gram: Gram, inputs: Sequence[str], label: str, noise: Mapping[str, float], scales: Scales
) -> LinearModel:
    """Return the model of counts that is best with independent noise to come, in SI units."""
    return fit_penalised(gram, inputs, label, _variances(gram, inputs, noise, scales))


def fit_errors_in_variables(
    gram: Gram, inputs: Sequence[str], label: str, noise: Mapping[str, float], scales: Scales
) -> LinearModel:
    """Return the model of counts for signals without `noise` (deviations, physical) in them.

    Raises `DataError` if signals vary less, `QuestionError` for one that is no input.
    """
    variances = _variances(gram, inputs, noise, scales)
    return fit_penalised(gram, inputs, label, [-variance for variance in variances])


def _variances(
    gram: Gram, inputs: Sequence[str], noise: Mapping[str, float], scales: Scales
) -> list[Fraction]:
    unknown = [name for name in noise if name not in inputs]
    if unknown:
        raise QuestionError(
            f"noise is given for {', '.join(unknown)}, which the model does not use. "
            f"It uses {', '.join(inputs)}."
        )
    return [gram.n * (Fraction(noise.get(name, 0)) / scales[name]) ** 2 for name in inputs]


def disturb(
    sums: ErrorSums,
    model: LinearModel,
    scales: Scales,
    *,
    bias: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
) -> ErrorSums:
    """Return the error sums to expect once bias and white noise are added to the signals.

    MSE' = MSE + 2 e (b'd) + (b'd)^2 + sum b_j^2 s_j^2, e the mean error. Model and sums are of
    counts; `bias` and `noise` (deviations) physical. Raises `QuestionError` for an unused signal.
    """
    shift = sum(
        (model.coefficients[i] * value for i, value in _counts(model, scales, bias or {})),
        Fraction(0),
    )
    variance = sum(
        ((model.coefficients[i] * value) ** 2 for i, value in _counts(model, scales, noise or {})),
        Fraction(0),
    )
    return replace(
        sums,
        p=sums.p + sums.n * shift,
        pp=sums.pp + 2 * shift * sums.p + sums.n * (shift**2 + variance),
        py=sums.py + shift * sums.y,
    )


def _counts(
    model: LinearModel, scales: Scales, values: Mapping[str, float]
) -> list[tuple[int, Fraction]]:
    unused = [name for name in values if name not in model.signals]
    if unused:
        raise QuestionError(
            f"the model does not use {', '.join(unused)}: it uses {', '.join(model.signals)}."
        )
    return [
        (model.signals.index(name), Fraction(value) / scales[name])
        for name, value in values.items()
    ]
