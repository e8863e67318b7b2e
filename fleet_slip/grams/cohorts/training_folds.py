"""A cohort made ready for one set of inputs: folds, and moments of each drive."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohorts.folding import FOLD_KEYS, PARTS, ROW_FOLDS, Folding, assign_folds
from fleet_slip.grams.cohorts.gram_cohort import Cohort, Served
from fleet_slip.regression.choice.nested_choice import TrainingFolds
from fleet_slip.regression.inference.drive_moments import ClusterUnit, DriveMoments
from fleet_slip.regression.validation.folds import CohortFolds, Folds


@dataclass(frozen=True)
class DriveFolds:
    """The drives that have all of some inputs, the fold of each, and what is computed from."""

    served: Served
    fold: IntArray
    training: TrainingFolds

    @property
    def moments(self) -> DriveMoments:
        """Moments of each drive, for cluster-robust errors and resampling."""
        if self.training.drives is None:
            return clustered_moments(self.served)
        return self.training.drives


def clustered_moments(
    served: Served,
    cluster: ClusterUnit | None = None,
    cars: Sequence[str] = (),
    *,
    intercept: bool = True,
) -> DriveMoments:
    """Return the moments of each drive, and which of them are one piece of evidence.

    By default cars where there are several, else drives; numbered by place among `cars`, so that
    two cohorts can share them. Without an intercept moments are about zero.
    """
    table = served.table if intercept else served.table.about_origin()
    owners = served.drives["vehicle_id"].to_pylist()
    cars = cars or owners
    if (cluster or ("vehicle" if len(set(cars)) > 1 else "drive")) == "drive":
        trips = served.drives["trip"].to_pylist()
        if len(set(trips)) == len(trips):
            return DriveMoments.of(table)
        _, of_trip = np.unique(trips, return_inverse=True)
        return DriveMoments.of(table, of_trip.astype(np.int64), "drive")
    number = {car: i for i, car in enumerate(sorted(set(cars)))}
    of_drive = np.array([number[car] for car in owners], dtype=np.int64)
    return DriveMoments.of(table, of_drive, "vehicle")


def drive_folds(
    cohort: Cohort,
    inputs: Sequence[str],
    folding: Folding,
    *,
    naive: bool = False,
    cluster: ClusterUnit | None = None,
    intercept: bool = True,
) -> DriveFolds:
    """Divide the drives with all the inputs into folds; `naive` takes rows for independent.

    Raises `DataError` if no drive has them all, and `QuestionError` for folds of rows.
    """
    if folding.by in (ROW_FOLDS, PARTS):
        raise QuestionError(
            f"with folds by {folding.by} there are no drives to hold out. Fold by drive for this."
        )
    served = cohort.serving(inputs)
    assignment = assign_folds(
        served.drives[FOLD_KEYS[folding.by]].to_pylist(), folding.by, folding.count
    )
    folds = CohortFolds.of([served.table], assignment).serving(inputs, catalogue().label)
    moments = None if naive else clustered_moments(served, cluster, intercept=intercept)
    training = TrainingFolds(folds, moments, input_scales(), intercept)
    return DriveFolds(served, assignment.fold, training)


def row_training(
    cohort: Cohort, inputs: Sequence[str], folding: Folding, *, intercept: bool = True
) -> TrainingFolds:
    """Return folds of rows; rows then count as independent. Raises `DataError`."""
    folds: Folds = cohort.folds(folding.by, folding.count).serving(inputs, catalogue().label)
    return TrainingFolds(folds, None, input_scales(), intercept)
