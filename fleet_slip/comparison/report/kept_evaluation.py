"""A kept evaluation, read back, and its estimators compared stretch by stretch of a drive."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.estimators import TrainedModels
from fleet_slip.comparison.evaluation.evaluate import evaluations_of
from fleet_slip.comparison.evaluation.own_car import own_car_evaluations
from fleet_slip.comparison.evaluation.scenario_runs import ErrorFigures, EvaluatedScenario
from fleet_slip.errors import DataError
from fleet_slip.files.documents import Document
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.regression.exact.figures import student_t_two_sided
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ
from fleet_slip.warehouse.tables import Warehouse

Side = Literal["inside", "outside"]


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

    def rows(self, key: Literal["checks", "comparisons"]) -> Sequence[Mapping[str, Any]]:
        """Return one of the document's lists."""
        rows: Sequence[Mapping[str, Any]] = self.document.content[key]
        return rows

    @property
    def gps_noise(self) -> Mapping[str, Any] | None:
        """The filters' errors over the noise of GPS; None in evaluations without it."""
        sweep: Mapping[str, Any] | None = self.document.content.get("gps_noise")
        return sweep

    @cached_property
    def models(self) -> Mapping[str, str]:
        """The estimator's name of each model of Table I that the cohort could serve."""
        return {
            about["table_one"]: name
            for name, about in self.estimators.items()
            if about["group"] == self.group and "table_one" in about
        }

    def of_kind(self, kind: str) -> list[str]:
        """Return the names of the estimators of a kind: regression or filter."""
        return [name for name, about in self.estimators.items() if about["kind"] == kind]

    def figures(self, scenario: str, estimator: str) -> ErrorFigures | None:
        """Return the error figures over a whole drive; None if that was not evaluated."""
        found = self._result(scenario, estimator)
        return None if found is None else _figures(found)

    def part(self, scenario: str, estimator: str, side: Side, section: str) -> ErrorFigures | None:
        """Return the error figures inside or outside of a section; None if there is none."""
        found = self._result(scenario, estimator)
        if found is None or section not in found[side]:
            return None
        return _figures(found[side][section])

    def stretches(self, scenario: str, section: str) -> list[tuple[float, float]]:
        """Return begin and end in s of the stretches of a section; none if there is no such."""
        sections = self.scenarios[scenario]["sections"] if scenario in self.scenarios else []
        return [
            (stretch["from_s"], stretch["until_s"])
            for found in sections
            if found["name"] == section
            for stretch in found["stretches"]
        ]

    def require_models(self, trained: TrainedModels) -> None:
        """Raise `DataError` if today's data make others of the models of Table I."""
        now = {name: model.as_dict() for name, model in trained.estimators().items()}
        for name in self.models.values():
            kept = self.estimators[name]
            if name not in now or now[name] != {key: kept.get(key) for key in now[name]}:
                raise self._changed(f"the cohort of {self.group}")

    def require_figures(self, runs: Mapping[str, EvaluatedScenario]) -> None:
        """Raise `DataError` if an estimator is off by more or less on a drive of today."""
        for scenario, run in runs.items():
            for name, result in run.results.items():
                kept = self.figures(scenario, name)
                if kept is None or not _same(kept.rmse_deg, result.whole.rmse_deg):
                    raise self._changed(f"the drive of {scenario}, or {name},")

    def _changed(self, what: str) -> DataError:
        return DataError(
            f"{what} has changed since evaluation {self.document.number}. Run: fleet-slip "
            f"evaluate {self.group}"
        )

    def _result(self, scenario: str, estimator: str) -> Mapping[str, Any] | None:
        if scenario not in self.scenarios:
            return None
        result: Mapping[str, Any] | None = self.scenarios[scenario]["results"].get(estimator)
        return result


SAME = 1e-6
"""Relative difference below which two figures of the same estimates are the same."""


def _same(first: float | None, second: float | None) -> bool:
    if first is None or second is None:
        return first is second
    return math.isclose(first, second, rel_tol=SAME)


def _figures(found: Mapping[str, Any]) -> ErrorFigures:
    return ErrorFigures(**{name: found[name] for name in ErrorFigures.__dataclass_fields__})


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


def latest_on_measured(warehouse: Warehouse, version: ModelVersion) -> Mapping[str, Any] | None:
    """Return the latest evaluation of a version on measured drives; None if there is none."""
    kept = own_car_evaluations(warehouse)
    documents = (kept.read(number).content for number in reversed(kept.numbers()))
    return next((one for one in documents if one["model"] == version.reference), None)


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
