"""All k+1 nested models of an order from one elimination (Section II-B of the paper)."""

from collections.abc import Sequence

from fleet_slip.errors import DataError
from fleet_slip.regression.exact.elimination import eliminate
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, dependence, fit_leading, moments


def nested_fits(
    gram: Gram, order: Sequence[str], label: str, *, intercept: bool = True
) -> list[Fit]:
    """Return the exact fits of the first 0, 1, ..., k signals of an order.

    One Bareiss pass yields every residual sum of squares (bordered over principal minors) and
    every leading triangular system. Raises `DataError` for dependent signals.
    """
    part = gram.restrict([*order, label])
    triangle = eliminate(moments(part, intercept=intercept))
    if triangle.singular is not None:
        raise DataError(dependence(part, order, intercept=intercept))
    sizes = range(len(order) + 1)
    return [fit_leading(part, triangle, size, intercept=intercept) for size in sizes]
