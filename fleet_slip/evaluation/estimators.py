"""What is evaluated: anything that turns a drive's signals into side-slip angles."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.regression.exact import LinearModel
from fleet_slip.selection.compare import Selection, select
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.warehouse.tables import Warehouse

Signals = Mapping[str, FloatArray]
"""One drive at 100 Hz: an array of shape (ticks,) for each SI column; NaN where null."""

Estimate = Callable[[Signals], FloatArray]
"""Side-slip angle in rad at every tick, shape (ticks,); NaN where there is no estimate."""

TABLE_ONE = "table1"
"""The model list with the paper's five sets of signals."""


@dataclass(frozen=True)
class LinearEstimate:
    """The paper's estimator: an intercept in rad and a coefficient for each SI column.

    A null in any of its signals leaves no estimate.
    """

    intercept: float
    coefficients: Mapping[str, float]

    @classmethod
    def of(cls, model: LinearModel) -> "LinearEstimate":
        """Return the estimator of a model of physical values."""
        weights = model.weights
        return cls(model.offset, {catalogue()[name].column: weights[name] for name in weights})

    @classmethod
    def published(cls, manifest: Manifest) -> "LinearEstimate":
        """Return the estimator that a manifest publishes.

        Raises `QuestionError` for a model with features, which are SQL and not signals.
        """
        features = [term.signal for term in manifest.terms if term.sql]
        if features:
            raise QuestionError(
                f"{manifest.name} uses the features {', '.join(features)}, and test drives are "
                "evaluated on signals alone. Use: fleet-slip score"
            )
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
class TrainedModels:
    """A published model, and the five models of Table I on the cohort that it was trained on."""

    version: ModelVersion
    selection: Selection

    @property
    def table_one(self) -> dict[str, str]:
        """Return the estimator's name of each model of Table I that the cohort can serve."""
        return {
            model.name: f"{self.version.reference}/{model.name}" for model in self.selection.models
        }

    def estimators(self) -> dict[str, LinearEstimate]:
        """Return the models of Table I, then the published one, by name."""
        fitted = {
            self.table_one[model.name]: LinearEstimate.of(model.model)
            for model in self.selection.models
        }
        return {
            **fitted,
            self.version.reference: LinearEstimate.published(self.version.manifest),
        }

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
    """Fit the models of Table I on a published model's cohort, as it is now, from its Gram rows.

    Raises `DataError` if the cohort is empty now.
    """
    cohort = load_cohort(warehouse, version.manifest.trained_on.cohort)
    models = load_model_list(TABLE_ONE)
    return TrainedModels(version, select(cohort, models.model, models.folds))
