"""Accuracy of predictions from exact sums of predictions and labels."""

import math
import operator
from dataclasses import dataclass
from fractions import Fraction

from fleet_slip.base import Record
from fleet_slip.regression import exact
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel


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


def student_t_two_sided(t: float, degrees: float) -> float:
    """Return the two-sided p-value of Student's t distribution.

    Parameters
    ----------
    t : float
        Value of the statistic.
    degrees : float
        Degrees of freedom, above 0.

    Returns
    -------
    float
        P(|T| >= |t|).
    """
    from scipy.special import stdtr  # noqa: PLC0415 - slow

    return float(2 * stdtr(degrees, -abs(t)))


def student_t_quantile(p: float, degrees: float) -> float:
    """Return the quantile of Student's t distribution.

    Parameters
    ----------
    p : float
        Probability of a smaller value, between 0 and 1.
    degrees : float
        Degrees of freedom, above 0.

    Returns
    -------
    float
    """
    from scipy.special import stdtrit  # noqa: PLC0415 - slow

    return float(stdtrit(degrees, p))
