"""A cohort made ready for one set of inputs: folds, and moments of each drive."""

from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohort import Cohort, Served, assign_folds
from fleet_slip.grams.folding import FOLD_KEYS, PARTS, ROW_FOLDS, Folding
from fleet_slip.regression.drive_moments import DriveMoments
from fleet_slip.regression.folds import CohortFolds, Folds
from fleet_slip.regression.nested_choice import Training


@dataclass(frozen=True)
class DriveFolds:
    """The drives that have all of some inputs, and the fold of each.

    Attributes:
        served: the drives.
        fold: fold of each drive, shape (drives,).
        training: what the regression modules work on.
    """

    served: Served
    fold: IntArray
    training: Training

    @property
    def moments(self) -> DriveMoments:
        """Moments of each drive, for cluster-robust errors and resampling."""
        if self.training.drives is None:
            return DriveMoments.of(self.served.table)
        return self.training.drives


def drive_folds(
    cohort: Cohort, inputs: Sequence[str], folding: Folding, *, naive: bool = False
) -> DriveFolds:
    """Divide the drives that have all the inputs into folds. `naive` takes rows for independent.

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
    moments = None if naive else DriveMoments.of(served.table)
    return DriveFolds(served, assignment.fold, Training(folds, moments, input_scales()))


def row_training(cohort: Cohort, inputs: Sequence[str], folding: Folding) -> Training:
    """Return folds of rows; rows then count as independent. Raises `DataError`."""
    folds: Folds = cohort.folds(folding.by, folding.count).serving(inputs, catalogue().label)
    return Training(folds, None, input_scales())
