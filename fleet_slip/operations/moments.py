"""Mean moments of each drive in float64, for statistics that compare drives with one another."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.gram import GramTable
from fleet_slip.regression.special import FloatArray


@dataclass(frozen=True)
class MeanMoments:
    """Mean of u u' over each drive's rows, with u = (1, counts).

    Attributes:
        signals: k names.
        matrices: shape (drives, k+1, k+1).
    """

    signals: tuple[str, ...]
    matrices: FloatArray

    @classmethod
    def of(cls, table: GramTable) -> "MeanMoments":
        """Divide the sums of a table by its rows."""
        k = len(table.signals)
        n = table.n.astype(np.float64)[:, None]
        matrices = np.ones((len(table), k + 1, k + 1))
        matrices[:, 0, 1:] = matrices[:, 1:, 0] = table.sums / n
        i, j = np.tril_indices(k)
        matrices[:, i + 1, j + 1] = matrices[:, j + 1, i + 1] = table.products / n
        return cls(table.signals, matrices)

    def __len__(self) -> int:
        """Return the number of drives."""
        return len(self.matrices)

    def position(self, signal: str) -> int:
        """Return where a signal stands in u."""
        return self.signals.index(signal) + 1

    def exchanged(self, a: str, b: str) -> "MeanMoments":
        """Return the moments as they would be with two signals exchanged."""
        order = np.arange(len(self.signals) + 1)
        i, j = self.position(a), self.position(b)
        order[[i, j]] = order[[j, i]]
        return MeanMoments(self.signals, self.matrices[:, order][:, :, order])

    def covariances(self) -> FloatArray:
        """Return the covariance matrices of the counts, shape (drives, k, k)."""
        mean = self.matrices[:, 0, 1:]
        return np.asarray(self.matrices[:, 1:, 1:] - mean[:, :, None] * mean[:, None, :])
