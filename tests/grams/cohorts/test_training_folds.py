"""A cohort made ready for a set of inputs."""

import numpy as np
import pytest

from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import drive_folds
from fleet_slip.grams.folding import Folding, FoldKey
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.gram import Gram
from tests.support.cohorts import INPUTS, LABEL, cohort_of, driven, rows_of

COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)


@pytest.mark.parametrize(
    ("by", "column"), [("drive", "drive_id"), ("vehicle", "vehicle_id"), ("day", "day")]
)
def test_a_fold_holds_out_whole_drives_cars_or_days(by: FoldKey, column: str) -> None:
    drives = driven(1, COEFFICIENTS, drives=20)
    cohort = cohort_of(drives)
    training, fold_of = drive_folds(cohort, INPUTS, Folding(by=by, count=4))
    pairs = set(zip(cohort.drives[column].to_pylist(), fold_of.tolist(), strict=True))
    assert len(pairs) == len({value for value, _ in pairs})
    for number, gram in enumerate(training.folds.grams):
        mine = [one for one, fold in zip(drives, fold_of, strict=True) if fold == number]
        assert gram == Gram.from_counts((*INPUTS, LABEL), rows_of(mine))
    assert training.folds.total.n == 20 * 80
    table = cohort.serving(INPUTS).table
    assert np.array_equal(training.drives.each, DriveMoments.of(table).each)


def test_drives_without_a_signal_are_left_out_and_without_any_that_is_told() -> None:
    cohort = cohort_of(driven(1, COEFFICIENTS))
    training, fold = drive_folds(cohort, ["ay", "ax"], Folding(count=3))
    assert training.drives.signals == ("ay", "ax", LABEL)
    assert len(training.drives) == len(fold) == 12
    with pytest.raises(DataError, match="wheel_fl"):
        drive_folds(cohort, ["ay", "wheel_fl"], Folding(count=3))
