"""What a learned rival sees: logged signals, and the columns of a model beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.definitions import Definition
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.drive_columns import DriveCounts
from fleet_slip.columns.blocks.numbered_columns import NumberedColumns
from fleet_slip.columns.blocks.row_code import RowColumn
from fleet_slip.comparison.evaluation.estimators import Signals, as_counts
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.rivals.learner import Fitted, one_thread
from fleet_slip.models.manifest import Manifest


@dataclass(frozen=True)
class Inputs:
    """Columns of counts, computed as those of the Gram rows are, and the value of a count.

    Attributes:
        scales: physical value of a count of each column, by name, in order.
        features: those of one row among what the columns are made of.
        definitions: those of the columns over time.
    """

    scales: Mapping[str, float]
    features: Mapping[str, RowColumn] = field(default_factory=dict)
    definitions: Mapping[str, Definition] = field(default_factory=dict)

    @classmethod
    def of_signals(cls, names: Sequence[str]) -> "Inputs":
        """Return logged signals as inputs."""
        return cls({name: float(catalogue()[name].scale) for name in names})

    @classmethod
    def of_model(cls, manifest: Manifest, signals: Sequence[str]) -> "Inputs":
        """Return logged signals, and then what a published model sees and they are not.

        Of a gated column, the column without its gate, and the counts of what opens the gate: the
        product of both is what these learners make themselves.
        """
        scales = {name: float(catalogue()[name].scale) for name in signals}
        definitions: dict[str, Definition] = {}
        for term in manifest.terms:
            scale = float(catalogue()[term.signal].scale if term.logged else term.scale)
            one = term.definition
            if one is None:
                scales.setdefault(term.signal, scale)
                continue
            for part in one.parts:
                if part not in definitions.values():
                    name = term.signal if part == one else _name(part, scales)
                    definitions[name] = part
                    scales[name] = 1.0 if one.gate and part == one.gate.by else scale
        rows = {name: RowColumn(name, parse(sql)) for name, sql in manifest.features.items()}
        return cls(scales, rows, definitions)

    @property
    def names(self) -> tuple[str, ...]:
        """The columns' names."""
        return tuple(self.scales)

    @cached_property
    def columns(self) -> NumberedColumns:
        """What computes the columns of a drive."""
        return NumberedColumns.of(self.names, self.features, self.definitions)

    def beside(self, signal: str) -> "Inputs":
        """Return the same with a logged signal as the last one."""
        return replace(self, scales={**self.scales, signal: float(catalogue()[signal].scale)})

    def values(self, drive: DriveCounts) -> FloatArray:
        """Return the physical values of a drive, shape (rows, columns); NaN where missing.

        Raises `DataError` for a drive that cannot be looked back on.
        """
        scales = np.array(list(self.scales.values()))
        return np.asarray((self.columns.compute(drive) * scales[:, None]).T)


def _name(column: Definition, taken: Mapping[str, float]) -> str:
    """Return a name for a column that a model has behind a gate only."""
    name = f"{column.of}_{column.over or 'now'}_{column.ticks}"
    return name if name not in taken else f"{name}_{len(taken)}"


@dataclass(frozen=True)
class LearnedEstimate:
    """A fitted learner as an estimator of a drive's signals.

    Attributes:
        inputs: what it sees.
        fitted: what computes side-slip from them.
        facts: what the car knows of itself.
    """

    inputs: Inputs
    fitted: Fitted
    facts: Mapping[str, Any] = field(default_factory=dict)

    def in_drive(self, drive: EvaluatedDrive) -> "LearnedEstimate":
        """Return the estimator in the car of a drive."""
        return replace(self, facts=drive.facts)

    def __call__(self, signals: Signals) -> FloatArray:
        """Estimate side-slip in rad at every tick; NaN where an input is missing."""
        plan = self.inputs.columns.plan
        inputs = self.inputs.values(as_counts(signals, plan.signals, self.facts))
        complete = np.isfinite(inputs).all(axis=1)
        estimates = np.full(len(inputs), np.nan)
        if complete.any():
            with one_thread():
                estimates[complete] = self.fitted.predict(inputs[complete])
        return estimates
