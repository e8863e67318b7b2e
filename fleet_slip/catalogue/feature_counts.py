"""The counts of a feature by numpy, as its SQL computes them; without a database or a compiler."""

from collections.abc import Callable, Mapping

import numpy as np

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.arithmetic import Arithmetic


def feature_counts(
    arithmetic: Arithmetic, limit: int, counts: Mapping[str, IntArray], present: BoolArray
) -> tuple[IntArray, BoolArray]:
    """Return the counts of a feature, clipped to ±limit, and where it has a value, (rows,) each.

    `counts` are int64 and have the signals in it; `present` is where none of them is missing. There
    is no value below the guard, nor where the divisor is not positive.
    """
    there = present.copy()
    found: list[IntArray] = []
    for number, step in enumerate(arithmetic.steps):
        if step.name:
            found.append(counts[step.name])
        elif not step.function:
            found.append(np.asarray(step.value, dtype=np.int64))
        else:
            operands = [found[i] for i in step.operands]
            if step.function == "//":
                there &= operands[1] > 0
            found.append(_OPERATIONS[step.function](*operands))
        if number == arithmetic.guard:
            there &= found[-1] >= arithmetic.at_least
    return np.broadcast_to(np.clip(found[-1], -limit, limit), present.shape), there


def _divided(a: IntArray, b: IntArray) -> IntArray:
    """Return a / b truncated towards zero; anything where b is not positive."""
    size = np.abs(a) // np.maximum(b, 1)
    return np.where(a < 0, -size, size)


_OPERATIONS: Mapping[str, Callable[..., IntArray]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "//": _divided,
    "negative": np.negative,
    "abs": np.abs,
    "sign": np.sign,
}
