"""Which drives and cars the Gram rows of a cohort are of."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.regression.folds import hash_number

Hashes = NDArray[np.uint64]
"""Hashes of drives (`hash_number`): what tells one from others, in 8 bytes."""


@dataclass(frozen=True)
class Members:
    """The drives and cars of Gram rows, by the signals that these have.

    Attributes:
        drives: the hash of each Gram row's drive, by the row's signals, separated by commas.
        vehicles: the hashes of the cars, by the same.
        received: the hashes of the drives whose cars sent Gram rows and no log, by the same.
    """

    drives: Mapping[str, Hashes]
    vehicles: Mapping[str, Hashes]
    received: Mapping[str, Hashes] = field(default_factory=dict)

    def drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the hashes of the drives that have all of some signals, each once, sorted."""
        return _with(self.drives, signals)

    def count_received_with(self, signals: Collection[str]) -> int:
        """Return the number of drives without a log that have all of some signals."""
        return len(_with(self.received, signals))

    @property
    def count_received(self) -> int:
        """Number of drives without a log."""
        return self.count_received_with(())

    def count_vehicles_with(self, signals: Collection[str]) -> int:
        """Return the number of cars that have all of some signals."""
        return len(_with(self.vehicles, signals))


def received_among(rows: pa.Table | pa.RecordBatch) -> BoolArray:
    """Return which Gram rows are of drives whose cars sent them, by the column `source`."""
    came = pc.fill_null(pc.equal(rows["source"].cast(pa.string()), RECEIVED), False)
    found: BoolArray = np.asarray(came.to_numpy(zero_copy_only=False), dtype=np.bool_)
    return found


def hash_numbers(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car."""
    return np.fromiter(map(hash_number, ids.to_pylist()), dtype=np.uint64, count=len(ids))


def _with(hashes: Mapping[str, Hashes], signals: Collection[str]) -> Hashes:
    found = [part for names, part in hashes.items() if set(signals) <= set(names.split(","))]
    return np.unique(np.concatenate(found)) if found else np.array([], dtype=np.uint64)
