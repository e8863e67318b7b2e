"""The evaluator: all estimators on the same rows, each segment of a drive by a held-out fit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.evaluation.evaluated_drives import DriveSignals, LabelledDrive, Segments
from fleet_slip.evaluation.evaluator import (
    MissingSignalError,
    evaluate,
    on_common_rows,
    pooled_statistics,
    variation_between_drives,
)
from fleet_slip.evaluation.measured_evaluation import FittedEstimator, cross_fitted, folds_of

ROWS = 100


@dataclass(frozen=True)
class Straight:
    """A drive straight ahead: an estimate is its error."""

    name: str
    evaluated: BoolArray

    @property
    def sideslip_rad(self) -> FloatArray:
        return np.zeros(len(self.evaluated))


def off_by(degrees: float) -> Callable[[Straight], FloatArray]:
    return lambda drive: np.full(len(drive.evaluated), np.radians(degrees))


def lacks_a_signal(drive: Straight) -> FloatArray:
    raise MissingSignalError(f"{drive.name} has no ay. Choose drives that have it.")


def straight(name: str, rows: int) -> Straight:
    return Straight(name, np.arange(ROWS) < rows)


def test_all_estimators_are_evaluated_on_the_rows_of_the_drive() -> None:
    drives = [straight("short", 25), straight("long", 75)]
    estimators = {"small": off_by(0.1), "large": off_by(0.2), "none": lacks_a_signal}
    runs = evaluate(drives, estimators)
    assert [run.name for run in runs] == ["short", "long"]
    for run, rows in zip(runs, (25, 75), strict=True):
        assert [*run.statistics] == [*estimators]
        assert {statistics.rows for statistics in run.statistics.values()} == {rows}
        assert run.statistics["large"].rmse_deg == pytest.approx(0.2)
        assert run.statistics["none"].coverage == 0
    pooled = pooled_statistics(runs)
    assert pooled["small"].rows == 100
    assert pooled["small"].rmse_deg == pytest.approx(0.1)


def test_comparable_estimators_are_judged_on_the_rows_that_all_have() -> None:
    def from_row(first: int) -> Callable[[Straight], FloatArray]:
        return lambda drive: np.where(np.arange(ROWS) < first, np.nan, np.arange(ROWS) / 100)

    estimators = {"whole": from_row(0), "late": from_row(4), "half": from_row(50)}
    estimators["none"] = from_row(ROWS)
    runs, excluded = on_common_rows(evaluate([straight("drive", ROWS)], estimators))
    pooled = pooled_statistics(runs)
    assert [*pooled] == ["whole", "late"]
    assert pooled["whole"] == pooled["late"] and pooled["whole"].rows == 96
    assert "50% of the rows" in excluded["half"] and "no drive has the signals" in excluded["none"]


def test_a_part_of_a_drive_has_statistics_of_its_own() -> None:
    (run,) = evaluate([straight("drive", 60)], {"any": off_by(0.1)})
    part = run.within(np.arange(ROWS) >= 50, "end")
    assert (part.name, part.statistics["any"].rows) == ("end", 10)
    assert run.statistics["any"].rows == 60


def test_the_standard_error_is_that_of_a_ratio_over_drives() -> None:
    runs = [
        evaluate([straight(str(degrees), ROWS)], {"any": off_by(degrees)})[0]
        for degrees in (0.1, 0.2, 0.3)
    ]
    variation = variation_between_drives(runs, "any")
    squares = np.array([0.01, 0.04, 0.09])
    expected = squares.std(ddof=1) / np.sqrt(3) / (2 * np.sqrt(squares.mean()))
    assert variation["rmse_standard_error_deg"] == pytest.approx(expected)
    assert variation["worst_drive"] == "0.3"
    assert variation_between_drives(runs[:1], "any")["rmse_standard_error_deg"] is None


def measured(name: str) -> LabelledDrive:
    signals = DriveSignals(*[np.full(ROWS, np.nan)] * 12)
    rows = pa.table({"tick": np.arange(ROWS)})
    return LabelledDrive(name, signals, np.zeros(ROWS), rows=rows, trip=name)


def returning(value: float) -> FittedEstimator:
    return FittedEstimator("", lambda drive: np.full(len(drive.rows), value))


def by_fold(folds: list[Segments], drive: LabelledDrive) -> list[float]:
    """Return the number of the fold that estimates each quarter of a drive."""
    fitted = {fold: {"any": returning(number)} for number, fold in enumerate(folds)}
    estimate = cross_fitted(fitted)["any"](drive)
    return [float(value) for value in estimate[:: ROWS // 4]]


def test_each_segment_is_estimated_by_the_fit_without_it() -> None:
    two = [measured("a"), measured("b")]
    assert by_fold(folds_of(two), two[1]) == [0, 1, 2, 3], "quarters"
    three = [*two, measured("c")]
    assert [by_fold(folds_of(three), drive) for drive in three] == [[0] * 4, [1] * 4, [2] * 4]


def test_a_fold_without_an_estimator_leaves_its_segments_without_an_estimate() -> None:
    first, second, *_ = folds_of([measured("a")])
    combined = cross_fitted({first: {"any": returning(0)}, second: {}})["any"](measured("a"))
    assert np.isfinite(combined).tolist() == [True] * 25 + [False] * 75
