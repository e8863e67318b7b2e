"""Mean moments of drives in float64, for statistics that compare drives with one another."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from fleet_slip.regression.gram import GramTable

BATCH = 2**12
"""Drives whose matrices are held together: some 1.4 KB each."""


@dataclass(frozen=True)
class MeanMoments:
    """Mean of u u' over each drive's rows, with u = (1, counts).

    Attributes
    ----------
    signals
        K names.
    matrices
        Shape (drives, k+1, k+1).
    """

    signals: tuple[str, ...]
    matrices: FloatArray

    @classmethod
    def from_table(cls, table: "GramTable") -> "MeanMoments":
        """Divide the sums of a table by its rows."""
        n = table.n.astype(np.float64)
        return cls(table.signals, table.moments() / n[:, None, None])

    @classmethod
    def from_rows(cls, values: Mapping[str, FloatArray], rows: BoolArray) -> "MeanMoments":
        """Return the moments of some rows of one drive, each signal about its mean."""
        table = np.array([signal[rows] for signal in values.values()])
        table -= table.mean(axis=1, keepdims=True)
        matrix = np.eye(len(table) + 1)
        matrix[1:, 1:] = table @ table.T / table.shape[1]
        return cls(tuple(values), matrix[None])

    def __len__(self) -> int:
        """Return the number of drives."""
        return len(self.matrices)

    def position(self, signal: str) -> int:
        """Return the index of a signal in u."""
        return self.signals.index(signal) + 1

    def exchanged(self, a: str, b: str) -> "MeanMoments":
        """Return the moments with two signals exchanged."""
        order = np.arange(len(self.signals) + 1)
        i, j = self.position(a), self.position(b)
        order[[i, j]] = order[[j, i]]
        return MeanMoments(self.signals, self.matrices[:, order][:, :, order])

    def covariances(self) -> FloatArray:
        """Return the covariance matrices of the counts, shape (drives, k, k)."""
        mean = self.matrices[:, 0, 1:]
        return np.asarray(self.matrices[:, 1:, 1:] - mean[:, :, None] * mean[:, None, :])


@dataclass(frozen=True)
class DriveBatches:
    """The mean moments of some drives of a table, in batches.

    Attributes
    ----------
    table
        Gram rows, which are half as large as the matrices.
    rows
        Positions of the drives in the table.
    """

    table: "GramTable"
    rows: NDArray[np.intp]

    @classmethod
    def from_table(cls, table: "GramTable", mask: BoolArray | None = None) -> "DriveBatches":
        """Take all drives of a table, or those of a mask."""
        return cls(table, np.arange(len(table)) if mask is None else np.flatnonzero(mask))

    def __len__(self) -> int:
        """Return the number of drives."""
        return len(self.rows)

    def __iter__(self) -> Iterator[MeanMoments]:
        """Yield the moments of the drives in their order."""
        for first in range(0, len(self), BATCH):
            yield MeanMoments.from_table(self.table.take(self.rows[first : first + BATCH]))

    @cached_property
    def mean(self) -> FloatArray:
        """The mean matrix, summed in the order of the drives; all drives have equal weight."""
        size = len(self.table.signals) + 1
        total = np.zeros((size, size))
        for batch in self:
            total = np.concatenate([total[None], batch.matrices]).sum(axis=0)
        return np.asarray(total / len(self))

    def evaluate(self, figures: Callable[[MeanMoments], FloatArray]) -> FloatArray:
        """Return the figures of all drives, computed by batch; the first axis is the drive."""
        return np.concatenate([figures(batch) for batch in self])
