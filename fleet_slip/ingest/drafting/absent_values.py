"""Finds what loggers write where there is no value: -9999, 65535, n.v."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.ingest.mapping.vocabulary import vocabulary

_FAR = 2.0
"""How many times the range of the others a number lies outside of it, to be none."""
_FEWEST = 20


@dataclass(frozen=True)
class Absent:
    """What means that there is no value.

    Attributes:
        texts: as a mapping has them under `missing`, numbers too.
        numbers: those of them that are numbers.
        doubtful: a channel and a number that means none in it, though another has it as a value.
    """

    texts: tuple[str, ...] = ()
    numbers: tuple[float, ...] = ()
    doubtful: tuple[tuple[str, float], ...] = ()


def find_absent(channels: Sequence[tuple[str, FloatArray, tuple[str, ...]]]) -> Absent:
    """Return what means no value in channels: their names, numbers, and texts among numbers."""
    known = vocabulary()["missing"]
    texts = [t for _, _, odd in channels for t in odd if t.lower() in known["texts"]]
    sentinels: dict[float, list[str]] = {}
    real: set[float] = set()
    for name, values, _ in channels:
        present = values[np.isfinite(values)]
        others = present[~np.isin(present, known["numbers"])]
        for number in np.unique(present[np.isin(present, known["numbers"])]):
            if others.size >= _FEWEST and _is_far(float(number), others):
                sentinels.setdefault(float(number), []).append(name)
            else:
                real.add(float(number))
    sure = tuple(number for number in sentinels if number not in real)
    doubtful = tuple((n, one) for one, names in sentinels.items() if one in real for n in names)
    written = [f"{number:.0f}" for number in sure]
    return Absent(tuple(dict.fromkeys([*written, *texts])), sure, doubtful)


def _is_far(number: float, others: FloatArray) -> bool:
    low, high = float(others.min()), float(others.max())
    margin = _FAR * max(high - low, 1e-6)
    return number > high + margin or number < low - margin


def without_absent(values: FloatArray, absent: Absent) -> FloatArray:
    """Return values with NaN for the numbers that mean none."""
    if not absent.numbers or not values.size:
        return values
    return np.where(np.isin(values, absent.numbers), np.nan, values)
