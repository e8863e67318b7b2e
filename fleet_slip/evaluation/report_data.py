"""Data of a report: a stored evaluation, and drives and models that are computed again."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.evaluation.evaluation_document import evaluations_of
from fleet_slip.evaluation.evaluator import ErrorStatistics, EvaluatedDrive
from fleet_slip.evaluation.filters import TrainedModels
from fleet_slip.evaluation.test_drives import TestDrive
from fleet_slip.grams.cohort import Cohort
from fleet_slip.models.registry import ModelVersion
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.inference import student_t_two_sided
from fleet_slip.regression.orders import RANKINGS, rank
from fleet_slip.regression.subsets import best_subsets
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import Document
from fleet_slip.warehouse.warehouse import Warehouse

PAPER_TABLE_TWO = {
    "1": (0.0135, 0.3018),
    "2": (-0.0146, 0.1754),
    "3": (-0.0209, 0.1556),
    "4": (-0.0060, 0.1549),
    "5": (-0.0079, 0.1505),
}
"""Mean and standard deviation of the error in deg on the paper's nominal drive, Table II."""

PAPER_CHOICE = "4"
"""The model of Table I that the paper compares with the Kalman filter."""

TOLERANCE = 1e-6
"""Relative difference below which two errors of the same estimates are equal."""


@dataclass(frozen=True)
class StoredEvaluation:
    """A stored evaluation, and the model version `NAME@VERSION` that it is about."""

    document: Document
    group: str

    @property
    def estimators(self) -> Mapping[str, Mapping[str, Any]]:
        """Descriptions of the estimators, by name."""
        estimators: Mapping[str, Mapping[str, Any]] = self.document.content["estimators"]
        return estimators

    @cached_property
    def scenarios(self) -> Mapping[str, Mapping[str, Any]]:
        """Results of the scenarios, by name, in the document's order."""
        return {scenario["name"]: scenario for scenario in self.document.content["scenarios"]}

    @cached_property
    def models(self) -> Mapping[str, str]:
        """Estimator name of each model of Table I whose signals the cohort has."""
        return {
            about["table_one"]: name
            for name, about in self.estimators.items()
            if about["group"] == self.group and "table_one" in about
        }

    def statistics(
        self, scenario: str, estimator: str, side: str = "", section: str = ""
    ) -> ErrorStatistics | None:
        """Return the errors over a drive, or `inside` or `outside` of a section of it."""
        result = self.scenarios.get(scenario, {}).get("results", {}).get(estimator, {})
        if side:
            result = result.get(side, {}).get(section)
        names = ErrorStatistics.__dataclass_fields__
        return ErrorStatistics(**{name: result[name] for name in names}) if result else None

    def stretches(self, scenario: str, name: str) -> list[tuple[float, float]]:
        """Return begin and end in s of the stretches of a section; empty if it has none."""
        return [
            (stretch["from_s"], stretch["until_s"])
            for section in self.scenarios.get(scenario, {"sections": []})["sections"]
            if section["name"] == name
            for stretch in section["stretches"]
        ]

    def require_models(self, trained: TrainedModels) -> None:
        """Raise `DataError` if the models of Table I differ on today's data."""
        bank = {name: about for name, (_, about) in trained.bank().items()}
        for name in self.models.values():
            stored, current = self.estimators[name], bank.get(name, {})
            if any(stored.get(key) != current.get(key) for key in ("intercept", "coefficients")):
                raise self._changed(f"the cohort of {self.group}")

    def require_errors(self, runs: Mapping[str, EvaluatedDrive[TestDrive]]) -> None:
        """Raise `DataError` if the error of an estimator differs on a drive of today."""
        for scenario, run in runs.items():
            for name, statistics in run.statistics.items():
                stored, current = self.statistics(scenario, name), statistics.rmse_deg
                before = stored.rmse_deg if stored else None
                if (before is None) != (current is None) or not math.isclose(
                    before or 0.0, current or 0.0, rel_tol=TOLERANCE
                ):
                    raise self._changed(f"the drive of {scenario}, or {name},")

    def _changed(self, subject: str) -> DataError:
        return DataError(
            f"{subject} has changed since evaluation {self.document.number}. Run: fleet-slip "
            f"evaluate {self.group}"
        )


def latest_evaluation(warehouse: Warehouse, version: ModelVersion) -> StoredEvaluation:
    """Return the latest evaluation of a model version. Raises `DataError` if there is none."""
    documents = evaluations_of(warehouse)
    for number in reversed(documents.numbers()):
        document = documents.read(number)
        first = next(iter(document.content["estimators"].values()))
        if first["group"] == version.reference:
            return StoredEvaluation(document, version.reference)
    raise DataError(
        f"{version.reference} has not been evaluated. Run: fleet-slip evaluate {version.reference}"
    )


# Comparison of estimators block by block of a drive.

BLOCK_S = 5.0
"""Length of a block; errors of neighbouring samples are correlated, of blocks hardly."""


@dataclass(frozen=True)
class ErrorDifference:
    """A paired t test of squared errors over blocks; t > 0 where the first is better."""

    t: float
    blocks: int
    p: float


def mean_squares(run: EvaluatedDrive[TestDrive], estimator: str) -> FloatArray:
    """Return the mean squared error in deg² of each block of a drive, shape (blocks,)."""
    error = np.degrees(run.estimates[estimator] - run.drive.sideslip_rad)[run.rows]
    size = int(BLOCK_S * SAMPLE_RATE_HZ)
    count = len(error) // size
    squares: FloatArray = (error[: count * size].reshape(count, size) ** 2).mean(axis=1)
    return squares


def compare_errors(run: EvaluatedDrive[TestDrive], first: str, second: str) -> ErrorDifference:
    """Compare the squared errors of two estimators by a paired t test over blocks."""
    gain = mean_squares(run, second) - mean_squares(run, first)
    t = float(gain.mean() / (gain.std(ddof=1) / math.sqrt(len(gain))))
    return ErrorDifference(t, len(gain), student_t_two_sided(t, len(gain) - 1))


def blocks_won(run: EvaluatedDrive[TestDrive], estimators: Sequence[str]) -> dict[str, int]:
    """Count the blocks of a drive in which each estimator has the smallest squared error."""
    squares = np.stack([mean_squares(run, name) for name in estimators])
    best = np.bincount(squares.argmin(axis=0), minlength=len(estimators))
    return dict(zip(estimators, best.tolist(), strict=True))


NEGLIGIBLE_R_SQUARED = 0.001
"""Loss of explained variance up to which a model is as good as the full one."""


@dataclass(frozen=True)
class SignalOrders:
    """Number of signals that each ranking, and the best subset, needs to explain nearly all."""

    signals: tuple[str, ...]
    needed: dict[str, int]
    best: int
    subsets: int


def compare_orders(cohort: Cohort, signals: Sequence[str]) -> SignalOrders:
    """Rank signals in every way and by subsets. Raises `DataError` if no drive has them all."""
    label = cohort.catalog.signals.label
    total = cohort.complete_cases(signals).table.total()
    best = best_subsets(total, signals, label, count=1)
    threshold = best[-1].best.r_squared - NEGLIGIBLE_R_SQUARED
    needed = {}
    for ranking in RANKINGS:
        fits = nested_fits(total, rank(ranking, total, signals, label), label)
        needed[ranking] = next(fit.size for fit in fits if fit.r_squared >= threshold)
    return SignalOrders(
        signals=tuple(signals),
        needed=needed,
        best=next(size.best.size for size in best if size.best.r_squared >= threshold),
        subsets=2 ** len(signals),
    )


DRAWN_FILTERS = ("kalman", "kalman_tuned")


@dataclass(frozen=True)
class ReportData:
    """Data of a report.

    Attributes
    ----------
    version
        The model version.
    evaluated
        Its latest evaluation.
    trained
        Its cohort, and the models of Table I on it.
    runs
        Drives of the evaluation's scenarios with the estimates that figures show.
    orders
        Effect of the order of the signals.
    on_measured
        Its latest evaluation on measured drives; None if there is none.
    shipped
        Names of all shipped scenarios, evaluated or not.
    """

    version: ModelVersion
    evaluated: StoredEvaluation
    trained: TrainedModels
    runs: Mapping[str, EvaluatedDrive[TestDrive]]
    orders: SignalOrders
    on_measured: Mapping[str, Any] | None
    shipped: tuple[str, ...]

    @property
    def choice(self) -> str:
        """Estimator name of the model that the paper chooses."""
        return self.evaluated.models[self.choice_number]

    @property
    def choice_number(self) -> str:
        """Its number in Table I; of the last model if the training drives lack its signals."""
        numbers = list(self.evaluated.models)
        return PAPER_CHOICE if PAPER_CHOICE in numbers else numbers[-1]
