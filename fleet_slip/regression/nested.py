"""All k+1 nested models of an order from one elimination (Section II-B of the paper)."""

from collections.abc import Sequence

from fleet_slip.errors import SelectionError
from fleet_slip.gram import Gram
from fleet_slip.regression.elimination import eliminate
from fleet_slip.regression.exact import Fit, dependence, fit_leading, moments


def nested_fits(gram: Gram, order: Sequence[str], label: str) -> list[Fit]:
    """Return the exact fits of the first 0, 1, ..., k signals of an order.

    One Bareiss pass yields every residual sum of squares (bordered over principal minors) and
    every leading triangular system. Raises `SelectionError` for dependent signals.
    """
    part = gram.restrict([*order, label])
    triangle = eliminate(moments(part))
    if triangle.singular is not None:
        raise SelectionError(dependence(part, order))
    return [fit_leading(part, triangle, size) for size in range(len(order) + 1)]
