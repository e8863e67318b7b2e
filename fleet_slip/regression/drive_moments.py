"""Moments of each drive in float64, for clusters and resampling.

They are taken about the cohort's mean, rounded to a count, in integers: nothing cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.errors import DataError
from fleet_slip.regression.gram import GramTable
from fleet_slip.regression.least_squares import LinearModel

ClusterUnit = Literal["drive", "vehicle"]
"""The independent unit of evidence: a cluster."""


def missing_signals_error(signals: Sequence[str]) -> DataError:
    """Return the error for a cohort without a drive that has all signals."""
    return DataError(
        f"no drive of the cohort has all of {', '.join(signals)}. Use fewer signals, or another "
        "cohort."
    )


def complete_cases(
    tables: Sequence[GramTable], signals: Sequence[str]
) -> tuple[GramTable, BoolArray]:
    """Return the drives that have all signals.

    Parameters
    ----------
    tables : sequence of GramTable
        Drives by set of signals.
    signals : sequence of str

    Returns
    -------
    tuple of (GramTable, bool array)
        The drives, and their mask among all drives of `tables`.

    Raises
    ------
    DataError
        If there are none.
    """
    served = [set(signals) <= set(table.signals) for table in tables]
    if not any(served):
        raise missing_signals_error(signals)
    parts = [table.restrict(signals) for table, yes in zip(tables, served, strict=True) if yes]
    mask = np.repeat(served, [len(table) for table in tables])
    if len(parts) == 1:
        return parts[0], mask
    stacked = GramTable(
        tuple(signals),
        np.concatenate([part.n for part in parts]),
        np.concatenate([part.sums for part in parts]),
        np.concatenate([part.products for part in parts]),
    )
    return stacked, mask


@dataclass(frozen=True)
class DriveMoments:
    """Moments of u = (1, (count - centre) / spread) of each drive. The label is last.

    Attributes
    ----------
    signals : tuple of str
        The k signals.
    centre : tuple of int, shape (k,)
        Mean count over all drives, rounded.
    spread : float array, shape (k,)
        Standard deviation of the counts; 1 for a constant.
    moments : float array, shape (drives, k + 1, k + 1)
        Sums of products of u.
    cluster : integer array, shape (drives,), or None
        Cluster of each drive; None if each drive is a cluster.
    unit : str
        The independent unit: drives of a vehicle share its biases and tyres.
    """

    signals: tuple[str, ...]
    centre: tuple[int, ...]
    spread: FloatArray
    moments: FloatArray
    cluster: IntArray | None = None
    unit: ClusterUnit = "drive"

    @classmethod
    def from_table(
        cls, table: GramTable, cluster: IntArray | None = None, unit: ClusterUnit = "drive"
    ) -> "DriveMoments":
        """Scale a table of drives. Raises `DataError` without rows."""
        total = table.total()
        if total.n == 0:
            raise DataError(f"no rows have all of {', '.join(table.signals)}.")
        centre = tuple(round(s / total.n) for s in total.sums)
        squares = np.array(
            [row[i] for i, row in enumerate(total.centered_products())], dtype=np.float64
        )
        spread = np.where(squares > 0, np.sqrt(squares) / total.n, 1.0)
        unit_of_u = np.array([1.0, *spread])
        moments = table.about(centre).moments() / np.outer(unit_of_u, unit_of_u)
        return cls(table.signals, centre, spread, moments, cluster, unit)

    def __len__(self) -> int:
        return len(self.moments)

    def take(self, rows: NDArray[Any]) -> "DriveMoments":
        """Return the drives at an index array or a mask, with the same centre and spread."""
        cluster = None if self.cluster is None else self.cluster[rows]
        return replace(self, moments=self.moments[rows], cluster=cluster)

    @property
    def clusters(self) -> int:
        """Number of clusters."""
        return len(self) if self.cluster is None else len(np.unique(self.cluster))

    def by_cluster(self, values: FloatArray) -> FloatArray:
        """Sum values of drives, shape (drives, ...), over each cluster."""
        if self.cluster is None:
            return values
        order = np.argsort(self.cluster, kind="stable")
        _, first = np.unique(self.cluster[order], return_index=True)
        return np.add.reduceat(values[order], first, axis=0)

    def direction(self, model: LinearModel) -> FloatArray:
        """Return w with w'u = prediction minus label, in spreads of the label; model in counts."""
        if model.label != self.signals[-1]:
            raise ValueError(f"the moments end with {self.signals[-1]}, not {model.label}")
        weights = dict(zip(model.signals, model.coefficients, strict=True))
        inputs = self.signals[:-1]
        level = model.intercept - self.centre[-1]
        level += sum(weights.get(s, 0) * c for s, c in zip(inputs, self.centre, strict=False))
        unit = self.spread[-1]
        slopes = [
            float(weights.get(s, 0)) * spread / unit
            for s, spread in zip(inputs, self.spread, strict=False)
        ]
        return np.array([float(level) / unit, *slopes, -1.0])
