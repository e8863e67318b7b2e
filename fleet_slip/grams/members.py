"""Which drives and cars the Gram rows of a cohort are of."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.regression.folds import hash_number

Hashes = NDArray[np.uint64]
"""Hashes of drives (`hash_number`): what tells one from others, in 8 bytes."""


@dataclass(frozen=True)
class Members:
    """The drives and cars of Gram rows, by the signals that these have.

    Attributes:
        drives: the hash of each Gram row's drive, by the row's signals, separated by commas.
        vehicles: the hashes of the cars, by the same.
    """

    drives: Mapping[str, Hashes]
    vehicles: Mapping[str, Hashes]

    def drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the hashes of the drives that have all of some signals, each once, sorted."""
        return _with(self.drives, signals)

    def count_vehicles_with(self, signals: Collection[str]) -> int:
        """Return the number of cars that have all of some signals."""
        return len(_with(self.vehicles, signals))


def hash_numbers(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car."""
    return np.fromiter(map(hash_number, ids.to_pylist()), dtype=np.uint64, count=len(ids))


def _with(hashes: Mapping[str, Hashes], signals: Collection[str]) -> Hashes:
    found = [part for names, part in hashes.items() if set(signals) <= set(names.split(","))]
    return np.unique(np.concatenate(found)) if found else np.array([], dtype=np.uint64)
