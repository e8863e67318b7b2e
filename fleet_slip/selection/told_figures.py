"""What may be told of a model's cross-validation, where a minimum cohort is asked for."""

from typing import Any

from fleet_slip.regression.validation.crossval import CrossValidation
from fleet_slip.warehouse.minimum_cohort import tells_single_cars


def told_figures(model: CrossValidation) -> dict[str, Any]:
    """Return a model's figures for a JSON document, without those of folds: one may be one car."""
    return model.as_dict() if tells_single_cars() else {**model.as_dict(), "folds": []}
