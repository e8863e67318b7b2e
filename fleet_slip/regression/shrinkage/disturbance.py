"""What sensor bias and noise do to a model's error, in closed form (the paper's section III-A).

With biases d_j and noise v_j, the prediction changes by b'd + sum b_j v_j: every sum follows.
"""

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction

from fleet_slip.errors import QuestionError
from fleet_slip.regression.exact.figures import ErrorSums
from fleet_slip.regression.exact.least_squares import LinearModel, Scales


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
