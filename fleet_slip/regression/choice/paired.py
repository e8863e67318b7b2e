"""By how much one model is worse than another on the same rows, with the error of that.

Cars differ, and rows of a car are alike. So the rows are divided into groups of whole units that
are independent: cars, or drives. With d the difference of the squared errors of a group and n its
rows, the difference of the mean squared errors is the ratio sum d / sum n, whose standard error is
that of a ratio of sums over groups of unequal size (Cochran, Sampling Techniques, 3rd edition,
1977, section 6.4). Both models share each group, so that what makes it difficult cancels.
"""

import math
from statistics import median

from fleet_slip.regression.choice.winner import Shortfall, Worth
from fleet_slip.regression.validation.crossval import CrossValidation


def compare_paired(model: CrossValidation, other: CrossValidation, worth: Worth) -> Shortfall:
    """Return how much larger a model's RMSE is than another's; each fold is an independent group.

    Raises `ValueError` if they were not tested on the same rows.
    """
    rows = _common_rows(model, other)
    differences = [
        n * (one.rmse - two.rmse) * (one.rmse + two.rmse)
        for n, one, two in zip(rows, model.folds, other.folds, strict=True)
    ]
    ratio, groups = math.fsum(differences) / sum(rows), len(rows)
    square = math.fsum((d - ratio * n) ** 2 for d, n in zip(differences, rows, strict=True))
    error = math.sqrt(square * groups / (groups - 1)) / sum(rows)
    both = model.pooled.rmse + other.pooled.rmse
    rmse = model.pooled.rmse - other.pooled.rmse
    worthless = rmse < worth.of(other.pooled.rmse)
    return Shortfall(model, rmse, error / both if both else 0.0, worthless)


def compare_typical(model: CrossValidation, other: CrossValidation, worth: Worth) -> Shortfall:
    """Return how much larger a model's RMSE is than another's in the median group.

    Each group has one vote, whatever its rows and its errors. So what is wrong in fewer than half
    of the groups does not decide (median of means; Lugosi and Mendelson, Mean estimation and
    regression under heavy-tailed distributions, 2019). The standard error is that of a median of
    normal numbers, whose deviation is told by the median of the absolute ones.

    Raises `ValueError` if they were not tested on the same rows.
    """
    _common_rows(model, other)
    differences = [one.rmse - two.rmse for one, two in zip(model.folds, other.folds, strict=True)]
    middle = median(differences)
    deviation = 1.4826 * median(abs(one - middle) for one in differences)
    error = math.sqrt(math.pi / 2 / len(differences)) * deviation
    return Shortfall(model, middle, error, middle < worth.of(other.pooled.rmse))


def _common_rows(model: CrossValidation, other: CrossValidation) -> list[int]:
    rows = [fold.rows for fold in model.folds]
    if model.fold_names != other.fold_names or rows != [fold.rows for fold in other.folds]:
        raise ValueError("the models were not tested on the same rows")
    return rows
