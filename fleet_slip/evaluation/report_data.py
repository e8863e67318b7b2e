"""Data of a report: a stored evaluation, and drives and models that are computed again."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from fleet_slip.errors import DataError
from fleet_slip.evaluation.evaluation_document import evaluations_of
from fleet_slip.evaluation.evaluator import ErrorStatistics, EvaluatedDrive
from fleet_slip.evaluation.filters import TrainedModels
from fleet_slip.evaluation.test_drives import TestDrive
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.page import degrees
from fleet_slip.storage.documents import Document
from fleet_slip.warehouse.warehouse import Warehouse

PAPER_CHOICE = "4"
"""The model of Table I that the paper compares with the Kalman filter."""

DRAWN_FILTERS = ("kalman", "kalman_tuned")

TOLERANCE = 1e-6
"""Relative difference below which two errors of the same estimates are equal."""


class NotEvaluatedError(LookupError):
    """The evaluation lacks a drive or an estimator, which the message names."""


@dataclass(frozen=True)
class ReportData:
    """Data of a report.

    Attributes
    ----------
    version
        The model version.
    document
        Its latest evaluation.
    trained
        Its cohort, and the models of Table I on it.
    runs
        Drives of the evaluation's scenarios with the estimates that figures show.
    """

    version: ModelVersion
    document: Document
    trained: TrainedModels
    runs: Mapping[str, EvaluatedDrive[TestDrive]]

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
            if about["group"] == self.version.reference and "table_one" in about
        }

    @property
    def choice_number(self) -> str:
        """Number of the model that the paper chooses, or of the last one that could be trained."""
        numbers = list(self.models)
        return PAPER_CHOICE if PAPER_CHOICE in numbers else numbers[-1]

    @property
    def choice(self) -> str:
        """Estimator name of this model."""
        return self.models[self.choice_number]

    def statistics(
        self, scenario: str, estimator: str, side: str = "", section: str = ""
    ) -> ErrorStatistics | None:
        """Return the errors over a drive, or `inside` or `outside` of a section of it."""
        result = self.scenarios.get(scenario, {}).get("results", {}).get(estimator, {})
        if side:
            result = result.get(side, {}).get(section)
        names = ErrorStatistics.__dataclass_fields__
        return ErrorStatistics(**{name: result[name] for name in names}) if result else None

    def errors(self, scenario: str, estimator: str = "", side: str = "") -> Any:
        """Return the statistics of an estimator, by default the paper's choice; none is None.

        Side `inside` or `outside` restricts them to the unstable section, or to the others. Raises
        `NotEvaluatedError`.
        """
        name = estimator or self.choice
        statistics = self.statistics(scenario, name, side, "unstable")
        if statistics is None or None in vars(statistics).values():
            section = "unstable section of " if side else ""
            raise NotEvaluatedError(f"{name} on the {section}drive {scenario}")
        return statistics

    def rmse(self, scenario: str, estimator: str = "") -> str:
        """Return the RMSE of an estimator over a drive, in words. Raises as `errors`."""
        return degrees(self.errors(scenario, estimator).rmse_deg)

    def scenario(self, name: str) -> Any:
        """Return the document of a scenario. Raises `NotEvaluatedError`."""
        try:
            return self.scenarios[name]
        except KeyError:
            raise NotEvaluatedError(f"drive {name}") from None

    def unstable_s(self, name: str) -> list[tuple[float, float]]:
        """Return begin and end in s of the unstable stretches. Raises as `scenario`."""
        return [
            (stretch["from_s"], stretch["until_s"])
            for section in self.scenario(name)["sections"]
            if section["name"] == "unstable"
            for stretch in section["stretches"]
        ]

    @property
    def all_signals(self) -> tuple[str, ...]:
        """Signals of the last model of Table I."""
        return tuple(dict.fromkeys(self.trained.selection.models[-1].signals))

    def require_unchanged(self) -> None:
        """Raise `DataError` if today's models or drives differ from the evaluation's.

        All numbers of a report are of the same data.
        """
        bank = self.trained.bank()
        changed = [
            f"the cohort of {self.version.reference}"
            for name in self.models.values()
            for key in ("intercept", "coefficients")
            if name not in bank or bank[name][1][key] != self.estimators[name][key]
        ]
        for scenario, run in self.runs.items():
            for name, current in run.statistics.items():
                stored = self.statistics(scenario, name)
                errors = [
                    math.nan if statistics is None or statistics.rmse_deg is None
                    else statistics.rmse_deg
                    for statistics in (stored, current)
                ]  # fmt: skip
                if not math.isclose(*errors, rel_tol=TOLERANCE) and not all(
                    map(math.isnan, errors)
                ):
                    changed.append(f"the drive of {scenario}, or {name},")
        if changed:
            raise DataError(
                f"{changed[0]} has changed since evaluation {self.document.number}. Run: "
                f"fleet-slip evaluate {self.version.reference}"
            )


def latest_evaluation(warehouse: Warehouse, version: ModelVersion) -> Document:
    """Return the latest evaluation of a model version. Raises `DataError` if there is none."""
    documents = evaluations_of(warehouse)
    for number in reversed(documents.numbers()):
        document = documents.read(number)
        first = next(iter(document.content["estimators"].values()))
        if first["group"] == version.reference:
            return document
    raise DataError(
        f"{version.reference} has not been evaluated. Run: fleet-slip evaluate {version.reference}"
    )
