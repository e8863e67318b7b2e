"""A kept evaluation, read back, and all else that a report shows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.evaluation.evaluate import evaluations_of
from fleet_slip.evaluation.filters import TrainedModels
from fleet_slip.evaluation.judge import ErrorFigures, EvaluatedScenario
from fleet_slip.grams.cohort import Cohort
from fleet_slip.models.registry import ModelVersion
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.figures import student_t_two_sided
from fleet_slip.regression.orders import RANKINGS, rank
from fleet_slip.regression.subsets import best_subsets
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import Document
from fleet_slip.warehouse.tables import Warehouse

PAPER_TABLE_TWO = {
    "1": (0.0135, 0.3018),
    "2": (-0.0146, 0.1754),
    "3": (-0.0209, 0.1556),
    "4": (-0.0060, 0.1549),
    "5": (-0.0079, 0.1505),
}
"""Mean and standard deviation of the error in deg on the paper's nominal drive, Table II."""

THE_PAPERS_CHOICE = "4"
"""The model of Table I that the paper compares with the Kalman filter."""

SAME = 1e-6
"""Relative difference below which two figures of the same estimates are the same."""


@dataclass(frozen=True)
class Evaluated:
    """An evaluation as it was kept, and the model version `NAME@VERSION` that it is about."""

    document: Document
    group: str

    @property
    def estimators(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each estimator, by name."""
        estimators: Mapping[str, Mapping[str, Any]] = self.document.content["estimators"]
        return estimators

    @cached_property
    def scenarios(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each scenario, by name, in its order."""
        return {one["name"]: one for one in self.document.content["scenarios"]}

    @cached_property
    def models(self) -> Mapping[str, str]:
        """The estimator's name of each model of Table I that the cohort could serve."""
        return {
            about["table_one"]: name
            for name, about in self.estimators.items()
            if about["group"] == self.group and "table_one" in about
        }

    def figures(
        self, scenario: str, estimator: str, side: str = "", section: str = ""
    ) -> ErrorFigures | None:
        """Return the error figures over a drive, or `inside` or `outside` of a section of it."""
        found = self.scenarios.get(scenario, {}).get("results", {}).get(estimator, {})
        if side:
            found = found.get(side, {}).get(section)
        names = ErrorFigures.__dataclass_fields__
        return ErrorFigures(**{name: found[name] for name in names}) if found else None

    def stretches(self, scenario: str, section: str) -> list[tuple[float, float]]:
        """Return begin and end in s of the stretches of a section; none if there is no such."""
        return [
            (stretch["from_s"], stretch["until_s"])
            for found in self.scenarios.get(scenario, {"sections": []})["sections"]
            if found["name"] == section
            for stretch in found["stretches"]
        ]

    def require_models(self, trained: TrainedModels) -> None:
        """Raise `DataError` if today's data make others of the models of Table I."""
        now = {name: about for name, (_, about) in trained.bank().items()}
        for name in self.models.values():
            kept, made = self.estimators[name], now.get(name, {})
            if any(kept.get(key) != made.get(key) for key in ("intercept", "coefficients")):
                raise self._changed(f"the cohort of {self.group}")

    def require_figures(self, runs: Mapping[str, EvaluatedScenario]) -> None:
        """Raise `DataError` if an estimator is off by more or less on a drive of today."""
        for scenario, run in runs.items():
            for name, result in run.results.items():
                kept, now = self.figures(scenario, name), result.whole.rmse_deg
                before = kept.rmse_deg if kept else None
                if (before is None) != (now is None) or not math.isclose(
                    before or 0.0, now or 0.0, rel_tol=SAME
                ):
                    raise self._changed(f"the drive of {scenario}, or {name},")

    def _changed(self, what: str) -> DataError:
        return DataError(
            f"{what} has changed since evaluation {self.document.number}. Run: fleet-slip "
            f"evaluate {self.group}"
        )


def latest_of(warehouse: Warehouse, version: ModelVersion) -> Evaluated:
    """Return the latest evaluation about a model version. Raises `DataError` if there is none."""
    kept = evaluations_of(warehouse)
    for number in reversed(kept.numbers()):
        document = kept.read(number)
        first = next(iter(document.content["estimators"].values()))
        if first["group"] == version.reference:
            return Evaluated(document, version.reference)
    raise DataError(
        f"{version.reference} has not been evaluated. Run: fleet-slip evaluate {version.reference}"
    )


# Estimators compared stretch by stretch of a drive.

BLOCK_S = 5.0
"""Errors of neighbouring samples depend on each other; over this time they nearly do not."""


@dataclass(frozen=True)
class ErrorDifference:
    """A paired t test of squared errors over blocks; t > 0 where the first is better."""

    t: float
    blocks: int
    p: float


def mean_squares(run: EvaluatedScenario, estimator: str) -> FloatArray:
    """Return the mean squared error in deg² of each block of a drive, shape (blocks,)."""
    error = np.degrees(run.estimates[estimator] - run.drive.sideslip_rad)[run.drive.evaluated]
    size = int(BLOCK_S * SAMPLE_RATE_HZ)
    whole = len(error) // size
    squares: FloatArray = (error[: whole * size].reshape(whole, size) ** 2).mean(axis=1)
    return squares


def difference(run: EvaluatedScenario, first: str, second: str) -> ErrorDifference:
    """Compare the squared errors of two estimators by a paired t test over blocks."""
    gain = mean_squares(run, second) - mean_squares(run, first)
    t = float(gain.mean() / (gain.std(ddof=1) / math.sqrt(len(gain))))
    return ErrorDifference(t, len(gain), student_t_two_sided(t, len(gain) - 1))


def blocks_won(run: EvaluatedScenario, estimators: Sequence[str]) -> dict[str, int]:
    """Return in how many blocks of a drive each estimator has the smallest squared error."""
    squares = np.stack([mean_squares(run, name) for name in estimators])
    best = np.bincount(squares.argmin(axis=0), minlength=len(estimators))
    return dict(zip(estimators, best.tolist(), strict=True))


CLOSE = 0.001
"""A model explains nearly all if it leaves no more than this of the variance to the full one."""


@dataclass(frozen=True)
class Ordering:
    """How many signals each ranking, and the best of all subsets, needs to explain nearly all."""

    signals: tuple[str, ...]
    needed: dict[str, int]
    best: int
    subsets: int


def compare_orders(cohort: Cohort, signals: Sequence[str]) -> Ordering:
    """Rank signals in every way beside all subsets. Raises `DataError` if no drive has them all."""
    label = cohort.catalog.signals.label
    total = cohort.serving(signals).table.total()
    best = best_subsets(total, signals, label, count=1)
    enough = best[-1].best.r_squared - CLOSE
    needed = {}
    for ranking in RANKINGS:
        fits = nested_fits(total, rank(ranking, total, signals, label), label)
        needed[ranking] = next(fit.size for fit in fits if fit.r_squared >= enough)
    return Ordering(
        signals=tuple(signals),
        needed=needed,
        best=next(size.best.size for size in best if size.best.r_squared >= enough),
        subsets=2 ** len(signals),
    )


DRAWN_FILTERS = ("kalman", "kalman_tuned")


@dataclass(frozen=True)
class ReportData:
    """All that a report shows.

    Attributes:
        version: the model version that it is about.
        evaluated: its latest evaluation.
        trained: its cohort, and the models of Table I on it.
        runs: drives of the evaluation's scenarios with the estimates that figures show.
        ordering: what the order of the signals is worth.
        on_measured: its latest evaluation on measured drives; None if there is none.
        shipped: names of all shipped scenarios, evaluated or not.
    """

    version: ModelVersion
    evaluated: Evaluated
    trained: TrainedModels
    runs: Mapping[str, EvaluatedScenario]
    ordering: Ordering
    on_measured: Mapping[str, Any] | None
    shipped: tuple[str, ...]

    @property
    def choice(self) -> str:
        """Estimator's name of the model that the paper settles on."""
        return self.evaluated.models[self.choice_number]

    @property
    def choice_number(self) -> str:
        """Its number in Table I; of the last that the training drives have the signals for."""
        names = list(self.evaluated.models)
        return THE_PAPERS_CHOICE if THE_PAPERS_CHOICE in names else names[-1]
