"""Every drive, or vehicle, a fold of its own."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams import folding
from fleet_slip.grams.folding import EACH, FoldCount, Folding, assign_folds
from fleet_slip.models.request import CandidateModel
from fleet_slip.models.select import select
from tests.support.cohorts import INPUTS, LABEL, cohort_of, driven

MODEL = CandidateModel(name="all", signals=INPUTS)


@pytest.mark.parametrize("by", ["drive", "vehicle"])
def test_figures_are_those_of_leaving_each_out_on_the_rows(by: str) -> None:
    drives = driven(1, (0.5, -0.2, 0.1, 0.3), drives=9)
    cohort = cohort_of(drives)
    key = cohort.drives["drive_id" if by == "drive" else "vehicle_id"].to_pylist()
    groups = np.repeat(key, [len(one.counts) for one in drives])
    rows = np.concatenate([one.counts for one in drives]).astype(float)
    predicted = cross_val_predict(
        LinearRegression(), rows[:, :-1], rows[:, -1], groups=groups, cv=LeaveOneGroupOut()
    )
    selection = select(cohort, [MODEL], Folding.model_validate({"by": by, "count": EACH}))
    (found,) = selection.models
    assert found.fold_names == tuple(sorted(set(key)))
    assert selection.as_dict()["folds"]["count"] == len(set(key))
    scale = float(catalogue()[LABEL].scale)
    rmse = float(np.sqrt(np.mean((predicted - rows[:, -1]) ** 2)))
    assert found.pooled.rmse == pytest.approx(rmse * scale, rel=1e-9)
    assert found.correlation == pytest.approx(np.corrcoef(predicted, rows[:, -1])[0, 1], rel=1e-9)


@pytest.mark.parametrize("count", [5, 6, 1000, EACH])
def test_five_drives_are_five_folds(count: FoldCount) -> None:
    """Hashed into five folds, some would share one; into four, they are."""
    names = [f"drive-{i}" for i in range(5)]
    assert assign_folds(names, "drive", count).names == tuple(names)
    assert set(assign_folds(names, "drive", 4).names) <= set("1234")


def test_more_folds_than_can_be_fitted_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folding, "MOST_FOLDS", 4)
    with pytest.raises(DataError, match="the cohort has 5, and at most 4 can be folds"):
        assign_folds(list("abcde"), "drive", EACH)
