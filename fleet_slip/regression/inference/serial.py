"""Serial correlation of the residuals, from a Gram of signals and their previous values.

Over rows with a predecessor: S0 = sum u_t u_t', S1 = sum u_t u_{t-1}', Sm = sum u_{t-1} u_{t-1}'.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from fleet_slip.errors import DataError
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, LinearModel, fit

_GRID = 2**20
_ROUNDS = 50


@dataclass(frozen=True)
class LagGram:
    """A Gram of signals `x` and of their previous values, `x` with the suffix."""

    gram: Gram
    suffix: str

    def before(self, name: str) -> str:
        """Return the name of a signal's previous value."""
        return name + self.suffix


@dataclass(frozen=True)
class SerialCorrelation:
    """Correlation rho of a residual with the one before, and sum (e_t - e_{t-1})^2 / sum e_t^2."""

    rho: float
    durbin_watson: float


def serial_correlation(model: LinearModel, gram: Gram, lagged: LagGram) -> SerialCorrelation:
    """Return the serial correlation of a model of counts. Raises `DataError` without residuals."""
    now_before, before = _residual_products(model, lagged)
    steps = error_sums(_difference(model), _with_differences(model, lagged)).squared_error
    total = error_sums(model, gram).squared_error
    if total == 0 or before == 0:
        raise DataError("the model has no residual: serial correlation is undefined.")
    return SerialCorrelation(float(now_before / before), float(steps / total))


def quasi_difference(lagged: LagGram, signals: Sequence[str], rho: Fraction) -> Gram:
    """Return the Gram of q u_t - p u_{t-1} for rho = p / q, exactly, in counts worth 1/q.

    Coefficients stay; the intercept becomes q - p times that of the levels.
    """
    p, q = rho.numerator, rho.denominator
    return lagged.gram.combine({name: {name: q, lagged.before(name): -p} for name in signals})


@dataclass(frozen=True)
class AutoregressiveFit:
    """The AR(1) model of counts for levels, its rho, and the fit of the differenced signals."""

    model: LinearModel
    rho: float
    differenced: Fit


def fit_autoregressive(lagged: LagGram, inputs: Sequence[str], label: str) -> AutoregressiveFit:
    """Fit AR(1) by Cochrane-Orcutt (1949), rho on a grid of 2^-20, exactly. Raises `DataError`."""
    signals = [*inputs, label]
    rho = Fraction(0)
    for _ in range(_ROUNDS):
        differenced = fit(quasi_difference(lagged, signals, rho), inputs, label)
        level = differenced.model.intercept / (rho.denominator - rho.numerator)
        coefficients = differenced.model.coefficients
        model = LinearModel(tuple(inputs), label, coefficients, level)
        now_before, before = _residual_products(model, lagged)
        if before == 0:
            raise DataError("the model has no residual: serial correlation is undefined.")
        new = Fraction(round(now_before / before * _GRID), _GRID)
        if abs(new) >= 1:
            raise DataError(f"the residuals are a random walk (rho = {float(new):.4f}).")
        if new == rho:
            break
        rho = new
    return AutoregressiveFit(model, float(rho), differenced)


def _residual_products(model: LinearModel, lagged: LagGram) -> tuple[Fraction, Fraction]:
    before = LinearModel(
        tuple(map(lagged.before, model.signals)),
        lagged.before(model.label),
        model.coefficients,
        model.intercept,
    )
    square = error_sums(before, lagged.gram).squared_error
    now = error_sums(model, lagged.gram).squared_error
    step = error_sums(_difference(model), _with_differences(model, lagged)).squared_error
    # (e_t - e_{t-1})^2 = e_t^2 - 2 e_t e_{t-1} + e_{t-1}^2
    return (now + square - step) / 2, square


def _difference(model: LinearModel) -> LinearModel:
    return LinearModel(model.signals, model.label, model.coefficients, Fraction(0))


def _with_differences(model: LinearModel, lagged: LagGram) -> Gram:
    return quasi_difference(lagged, [*model.signals, model.label], Fraction(1))
