"""What is evaluated: anything that turns a drive's signals into side-slip angles."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.drive_columns import as_counts
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.models.estimates.predictor import Predictor
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.regression.exact.least_squares import LinearModel
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.selection.select_models import Selection, select
from fleet_slip.warehouse.tables import Warehouse

Signals = Mapping[str, FloatArray]
"""One drive at 100 Hz: an array of shape (ticks,) for each SI column; NaN where null."""

Estimate = Callable[[Signals], FloatArray]
"""Side-slip angle in rad at every tick, shape (ticks,); NaN where there is no estimate."""

TABLE_ONE = "table1"
"""The model list with the paper's five sets of signals."""


@dataclass(frozen=True)
class LinearEstimate:
    """An intercept in rad and a coefficient for each SI column; a null leaves no estimate."""

    intercept: float
    coefficients: Mapping[str, float]

    @classmethod
    def of(cls, model: LinearModel) -> "LinearEstimate":
        """Return the estimator of a model of physical values."""
        weights = model.weights
        return cls(model.offset, {catalogue()[name].column: weights[name] for name in weights})

    @classmethod
    def published(cls, manifest: Manifest) -> "LinearEstimate":
        """Return the estimator that a manifest of logged signals publishes."""
        return cls(manifest.intercept, {term.column: term.coefficient for term in manifest.terms})

    def __call__(self, signals: Signals) -> FloatArray:
        """Return intercept + sum of coefficient times signal."""
        terms = [weight * signals[column] for column, weight in self.coefficients.items()]
        total: FloatArray = np.sum(terms, axis=0) + self.intercept
        return total

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs to compute the same estimates."""
        return {"intercept": self.intercept, "coefficients": dict(self.coefficients)}


@dataclass(frozen=True)
class ColumnEstimate:
    """A published model with features or columns over time, sample by sample as a car drives.

    It sees counts, as an ECU does: the columns are the integers that its Gram rows are made of.

    Attributes:
        manifest: what was published.
        predictor: what computes it.
        facts: what the car knows of itself.
    """

    manifest: Manifest
    predictor: Predictor
    facts: Mapping[str, Any] = field(default_factory=dict)

    def in_drive(self, drive: EvaluatedDrive) -> "ColumnEstimate":
        """Return the estimator in the car of a drive, which knows its facts."""
        return replace(self, facts=drive.facts)

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick; there is one row for every tick."""
        return self.predictor(as_counts(signals, self.predictor.plan.signals, self.facts))

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs to compute the same estimates."""
        return {
            "intercept": self.manifest.intercept,
            "coefficients": {term.column: term.coefficient for term in self.manifest.terms},
            "columns": {
                term.signal: term.definition.model_dump(mode="json")
                if term.definition
                else term.sql
                for term in self.manifest.terms
                if not term.logged
            },
        }


def published_estimate(manifest: Manifest) -> LinearEstimate | ColumnEstimate:
    """Return the estimator that a manifest publishes. Raises `RefusedError` if counts changed."""
    if all(term.logged for term in manifest.terms):
        return LinearEstimate.published(manifest)
    return ColumnEstimate(manifest, Predictor.of(manifest))


@dataclass(frozen=True)
class TrainedModels:
    """A published model, and the five models of Table I on the cohort that it was trained on."""

    version: ModelVersion
    selection: Selection

    @property
    def table_one(self) -> dict[str, str]:
        """Return the estimator's name of each model of Table I that the cohort can serve."""
        return {one.name: f"{self.version.reference}/{one.name}" for one in self.selection.models}

    def linear_estimators(self) -> dict[str, LinearEstimate]:
        """Return the models of Table I by name."""
        models = zip(self.table_one.values(), self.selection.models, strict=True)
        return {name: LinearEstimate.of(one.model) for name, one in models}

    def estimators(self) -> dict[str, LinearEstimate | ColumnEstimate]:
        """Return the models of Table I, then the published one, by name."""
        published = published_estimate(self.version.manifest)
        return {**self.linear_estimators(), self.version.reference: published}

    def descriptions(self) -> dict[str, dict[str, Any]]:
        """Return what a JSON document says of each estimator."""
        estimators = self.estimators()
        trained = {
            "kind": "regression",
            "group": self.version.reference,
            "cohort": self.selection.cohort.condition.text,
            "drives": self.selection.cohort.drives.num_rows,
            "rows": self.selection.cohort.rows,
        }
        fitted = {
            self.table_one[model.name]: {
                **trained,
                "table_one": model.name,
                "signals": list(model.signals),
                "cross_validated": model.pooled.as_dict(),
                **estimators[self.table_one[model.name]].as_dict(),
            }
            for model in self.selection.models
        }
        manifest, reference = self.version.manifest, self.version.reference
        published = {
            **trained,
            "published": reference,
            "sha256": self.version.sha256,
            "signals": list(manifest.signals),
            "cross_validated": manifest.cross_validation.model_dump(mode="json"),
            **estimators[reference].as_dict(),
        }
        return {**fitted, reference: published}


def train_models(warehouse: Warehouse, version: ModelVersion) -> TrainedModels:
    """Fit Table I on a published model's cohort as it is now. Raises `DataError` if it is empty."""
    cohort = load_cohort(warehouse, version.manifest.trained_on.cohort)
    models = load_model_list(TABLE_ONE)
    return TrainedModels(version, select(cohort, models.model, models.folds))
