"""The counts of a feature of a row by numpy; without a database or a compiler."""

from collections.abc import Callable, Mapping

import numpy as np

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.definitions import Definition
from fleet_slip.columns.lowering import Lowering
from fleet_slip.columns.operations import OPERATIONS, operands_of, operation_of, plain_of


def row_counts(
    one: Definition, counts: Mapping[str, IntArray], present: BoolArray
) -> tuple[IntArray, BoolArray]:
    """Return a feature's counts and where it has one, (rows,), from int64 counts and presence."""
    lowered = Lowering({name: place for place, name in enumerate(one.signals)})
    last = lowered.row(one)
    there = present.copy()
    found: list[IntArray] = []
    for step in lowered.steps:
        name, of = operation_of(step), [found[i] for i in operands_of(step)]
        if name == "signal":
            found.append(counts[one.signals[plain_of(step)[0]]])
        elif name == "constant":
            found.append(np.asarray(plain_of(step)[0], dtype=np.int64))
        else:
            missing = OPERATIONS[name].missing
            there &= of[1] > 0 if missing == "divisor" else True
            there &= of[0] >= of[1] if missing == "less" else True
            found.append(_NUMPY[name](*of))
    return np.broadcast_to(found[last], present.shape), there


def _divided(a: IntArray, b: IntArray) -> IntArray:
    """Return a / b truncated towards zero; anything where b is not positive."""
    size = np.abs(a) // np.maximum(b, 1)
    return np.where(a < 0, -size, size)


def _first(a: IntArray, _: IntArray) -> IntArray:
    return a


_NUMPY: Mapping[str, Callable[..., IntArray]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "//": _divided,
    "negative": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "clip": lambda a, limit: np.clip(a, -limit, limit),
    "at_least": _first,
    "where": _first,
}
