"""Estimates of a published model, sample by sample in the order of time, from logged counts."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.block_operations import BLOCK_ROWS
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveCounts, Workspace
from fleet_slip.compiling import kernel
from fleet_slip.models.manifest import Manifest

KEPT_ROWS = 2**16
"""Of longer drives no memory is kept: it is some 400 bytes a row."""


@dataclass(frozen=True)
class Predictor:
    """A published model on counts: the columns that it needs, and what a count of each adds.

    `coefficients` are in rad per physical value, which is `scales` times the count.
    """

    plan: ColumnPlan
    intercept: float
    coefficients: tuple[float, ...]
    scales: tuple[float, ...]
    _idle: list[Workspace] = field(default_factory=list, repr=False, compare=False)

    @classmethod
    def of(cls, manifest: Manifest) -> "Predictor":
        """Return what a manifest publishes, by features of its own.

        Raises `DataError` if these contradict each other, `RefusedError` if counts mean otherwise
        now.
        """
        manifest.require_same_counts()
        coefficients = tuple(term.coefficient for term in manifest.terms)
        scales = tuple(
            float(catalogue()[term.signal].scale if term.logged else term.scale)
            for term in manifest.terms
        )
        plan = ColumnPlan.of(manifest.signals, manifest.features, manifest.definitions)
        return cls(plan, manifest.intercept, coefficients, scales)

    @contextmanager
    def lend_workspace(self) -> Iterator[Workspace]:
        """Lend memory for one drive after the other; one that is not large is kept for the next."""
        try:
            workspace = self._idle.pop()  # no other thread has it then
        except IndexError:
            workspace = Workspace(self.plan)
        try:
            yield workspace
        finally:
            if workspace.rows_at_most <= KEPT_ROWS:
                self._idle.append(workspace)

    def __call__(self, drive: DriveCounts, workspace: Workspace | None = None) -> FloatArray:
        """Return the estimate at each row in rad, shape (rows,); NaN where a column is missing.

        Added up left to right and block by block, to the bits of `score --sql`. Raises `DataError`
        for a drive that cannot be looked back on.
        """
        workspace = workspace or Workspace(self.plan)
        workspace.load(drive)
        coefficients, scales = np.array(self.coefficients), np.array(self.scales)
        estimate: FloatArray = np.full(len(drive.ticks), self.intercept)
        for first in range(0, len(estimate), BLOCK_ROWS):
            workspace.compute_block(first)
            columns = workspace.block(first)[0]
            add_terms(columns, coefficients, scales, estimate[first : first + BLOCK_ROWS])
        return estimate


@kernel
def add_terms(columns: Any, coefficients: Any, scales: Any, estimate: Any) -> None:
    """Add a dot product's terms to the estimates, left to right; counts are (columns, rows)."""
    for number in range(len(columns)):
        column, coefficient, scale = columns[number], coefficients[number], scales[number]
        for row in range(len(estimate)):
            estimate[row] += coefficient * (column[row] * scale)
