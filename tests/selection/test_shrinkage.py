"""Ridge, lasso and Pace beside least squares on the same folds."""

import numpy as np
import pytest

from fleet_slip.catalogue.features import input_scales
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohorts.folding import Folding, assign_folds
from fleet_slip.regression.shrinkage.pace import ESTIMATORS
from fleet_slip.regression.validation.crossval import cross_validate_inputs
from fleet_slip.selection.shrinkage import PENALTIES, Shrunk, compare_shrinkage
from tests.support.cohorts import INPUTS, LABEL, Driven, cohort_of, driven, rows_of

FIVE = Folding(by="drive", count=5)


def compared(drives: list[Driven], *, naive: bool = False) -> dict[str, Shrunk]:
    found = compare_shrinkage(cohort_of(drives), INPUTS, FIVE, naive=naive, cluster="drive")
    return {one.cross_validation.name: one for one in found}


def collinear(drives: int, rows: int, noise: float) -> list[Driven]:
    """Steering wheel and yaw rate nearly the same, as on a road; few rows, much noise."""
    found = driven(2, (0.1, 0.3, 0.2, 0.0), drives=drives, rows=rows, noise=noise)
    rng = np.random.default_rng(0)
    for one in found:
        one.counts[:, 3] = one.counts[:, 2] + rng.integers(-20, 21, rows)
    return found


def test_every_method_is_named_once_and_only_two_have_a_penalty() -> None:
    found = compared(driven(1, (0.1, 0.4, 0.9, 0.2)))
    assert list(found) == ["least squares", "ridge", "lasso", *ESTIMATORS]
    assert [name for name, one in found.items() if one.penalty is not None] == ["ridge", "lasso"]
    assert {one.cross_validation.pooled.rows for one in found.values()} == {12 * 80}
    assert found["ridge"].as_dict()["penalty"] == found["ridge"].penalty


def test_least_squares_is_that_of_select() -> None:
    drives = driven(1, (0.1, 0.4, 0.9, 0.2))
    folds = cohort_of(drives).folds("drive", 5)
    alone = cross_validate_inputs("ols", folds, INPUTS, LABEL, input_scales())
    assert compared(drives)["least squares"].cross_validation.sums == alone.sums


def test_where_there_is_nothing_to_shrink_nothing_is_shrunk() -> None:
    found = compared(driven(1, (0.5, 0.4, 0.9, 0.7), drives=30, noise=5))
    plain = found["least squares"].cross_validation
    assert found["ridge"].penalty == PENALTIES[0]
    for name, one in found.items():
        assert one.cross_validation.correlation == pytest.approx(plain.correlation, abs=1e-4), name
        weights = one.cross_validation.model.weights
        for signal, weight in plain.model.weights.items():
            assert weights[signal] == pytest.approx(weight, rel=0.02), (name, signal)


def test_where_inputs_nearly_repeat_each_other_a_penalty_helps() -> None:
    found = compared(collinear(drives=12, rows=5, noise=600))
    plain, ridge = found["least squares"].cross_validation, found["ridge"]
    assert ridge.penalty is not None
    assert ridge.penalty > PENALTIES[0]
    assert ridge.cross_validation.pooled.rmse < plain.pooled.rmse
    sizes = [abs(one.model.weights["steering_wheel"]) for one in (ridge.cross_validation, plain)]
    assert sizes[0] < sizes[1]


def test_the_penalty_of_all_rows_is_the_best_of_the_list_on_held_out_folds() -> None:
    drives = collinear(drives=12, rows=5, noise=600)
    rows = rows_of(drives).astype(float)
    x, y = rows[:, :-1], rows[:, -1]
    errors = []
    of_row = np.repeat(assign_folds([one.drive for one in drives], "drive", 5).fold, 5)
    for penalty in PENALTIES:
        total = 0.0
        for number in set(of_row):
            rest = of_row != number
            mean, std = x[rest].mean(axis=0), x[rest].std(axis=0)
            z = (x[rest] - mean) / std
            beta = np.linalg.solve(
                z.T @ z / len(z) + penalty * np.eye(4), z.T @ (y[rest] - y[rest].mean()) / len(z)
            )
            estimate = y[rest].mean() + ((x[~rest] - mean) / std) @ beta
            total += float(np.sum((estimate - y[~rest]) ** 2))
        errors.append(total)
    assert compared(drives)["ridge"].penalty == PENALTIES[int(np.argmin(errors))]


def test_pace_trusts_less_where_only_drives_are_independent() -> None:
    """Each drive has an offset of its own, which hundreds of rows repeat."""
    drives = driven(7, (0.02, 0.02, 0.05, 0.02), drives=10, rows=200, noise=250)
    naive, robust = compared(drives, naive=True), compared(drives)
    for name in ("pace2", "pace4"):
        kept = [
            sum(abs(w) for w in one[name].cross_validation.counts.weights.values())
            for one in (naive, robust)
        ]
        assert kept[0] >= kept[1], name
    assert naive["pace2"].cross_validation.sums != robust["pace2"].cross_validation.sums
    for name in ("least squares", "ridge", "lasso"):
        assert naive[name].cross_validation.sums == robust[name].cross_validation.sums


def test_folds_with_too_few_rows_are_told() -> None:
    """Without two of the four cars there are fewer rows than coefficients."""
    drives = driven(1, (0.1, 0.4, 0.9, 0.2), drives=4, rows=2)
    with pytest.raises(DataError, match="linearly dependent"):
        compare_shrinkage(cohort_of(drives), INPUTS, Folding(by="vehicle", count=4), naive=True)


def test_a_penalty_needs_three_folds() -> None:
    two = Folding(by="drive", count=2)
    with pytest.raises(QuestionError, match="needs three folds"):
        compare_shrinkage(cohort_of(driven(1, (0.1, 0.4, 0.9, 0.2))), INPUTS, two)
