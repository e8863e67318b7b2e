"""A cohort made ready for a set of inputs."""

import numpy as np
import pytest

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohort import drive_folds, row_training
from fleet_slip.grams.folding import Folding, FoldKey
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.gram import Gram
from tests.support.cohorts import INPUTS, LABEL, Driven, cohort_of, driven, rows_of

COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)


@pytest.mark.parametrize(
    ("by", "column"), [("drive", "drive_id"), ("vehicle", "vehicle_id"), ("day", "day")]
)
def test_a_fold_holds_out_whole_drives_cars_or_days(by: FoldKey, column: str) -> None:
    drives = driven(1, COEFFICIENTS, drives=20)
    cohort = cohort_of(drives)
    ready = drive_folds(cohort, INPUTS, Folding(by=by, count=4))
    pairs = set(zip(cohort.drives[column].to_pylist(), ready.fold.tolist(), strict=True))
    assert len(pairs) == len({value for value, _ in pairs})
    for number, gram in enumerate(ready.training.folds.grams):
        mine = [one for one, fold in zip(drives, ready.fold, strict=True) if fold == number]
        assert gram == Gram.from_counts((*INPUTS, LABEL), rows_of(mine))
    assert ready.training.folds.total.n == 20 * 80


def test_drives_without_a_signal_are_left_out_and_without_any_that_is_told() -> None:
    cohort = cohort_of(driven(1, COEFFICIENTS))
    ready = drive_folds(cohort, ["ay", "ax"], Folding(count=3))
    assert ready.served.table.signals == ("ay", "ax", LABEL)
    assert len(ready.served.drives) == len(ready.fold) == 12
    with pytest.raises(DataError, match="wheel_fl"):
        drive_folds(cohort, ["ay", "wheel_fl"], Folding(count=3))


def test_moments_are_there_where_drives_count_as_independent() -> None:
    cohort = cohort_of(driven(1, COEFFICIENTS))
    naive = drive_folds(cohort, INPUTS, Folding(count=3), naive=True)
    robust = drive_folds(cohort, INPUTS, Folding(count=3))
    assert naive.training.drives is None
    assert robust.training.drives is not None
    expected = DriveMoments.of(robust.served.table).packed
    assert np.array_equal(robust.training.drives.packed, expected)


def test_rows_are_folded_as_the_feature_set_made_them() -> None:
    parts = [
        Driven(one.drive, one.counts[part::10], part=str(part + 1))
        for one in driven(2, COEFFICIENTS, drives=5)
        for part in range(10)
    ]
    cohort = cohort_of(parts, feature_set="rows")
    training = row_training(cohort, INPUTS, Folding(by="row", count=5))
    assert training.drives is None
    for number, gram in enumerate(training.folds.grams):
        mine = [one for one in parts if (int(one.part or 0) - 1) % 5 == number]
        assert gram == Gram.from_counts((*INPUTS, LABEL), rows_of(mine))
    with pytest.raises(QuestionError, match="no drives to hold out"):
        drive_folds(cohort, INPUTS, Folding(by="row", count=5))
    with pytest.raises(QuestionError, match="made 10 folds of rows"):
        row_training(cohort, INPUTS, Folding(by="row", count=11))
