"""What a claim and its verdict are."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from fleet_slip.comparison.evaluation.errors import ErrorFigures
from fleet_slip.comparison.report.findings.report_data import ReportData
from fleet_slip.comparison.report.tables.paper_tables import PAPER_TABLE_TWO
from fleet_slip.pages.text import listed

SLIGHT = 1.5
"""Largest ratio of root mean square errors that counts as slight, or as close.

Ratios, because an angle such as 0.1° may be more than the whole error to begin with; root mean
squares, because a mean error is an error.
"""

WELL = 0.44
"""Largest RMSE of an accurate estimate, as a share of the angle's own standard deviation.

It is that of an unbiased estimate with a correlation of 0.9.
"""


class Status(StrEnum):
    """What became of a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_TESTABLE = "not testable here"


@dataclass(frozen=True)
class Verdict:
    """How a claim turned out: what we found, and what it is due to."""

    status: Status
    figure: str
    why: str


class NotEvaluatedError(LookupError):
    """The evaluation lacks what a claim needs; the message says what."""


Judge = Callable[[ReportData], Verdict]


@dataclass(frozen=True)
class Claim:
    """One statement of the paper.

    Attributes:
        place: where it stands in the paper.
        statement: what it says, in our words.
        criterion: when we take it as reproduced.
        decide: decides by the data; may raise `NotEvaluatedError`.
    """

    place: str
    statement: str
    criterion: str
    decide: Judge

    def judge(self, data: ReportData) -> Verdict:
        """Return the verdict; not testable where the evaluation lacks what it needs."""
        absent = [name for name in PAPER_TABLE_TWO if name not in data.evaluated.models]
        if absent:
            return not_testable(
                "The drives that the model was trained on lack signals of model "
                f"{listed(absent)} of Table I, which the paper's statements are about."
            )
        try:
            return self.decide(data)
        except NotEvaluatedError as lacking:
            return not_testable(f"The evaluation has no {lacking}. Run: {_command(data)}")


def _command(data: ReportData) -> str:
    return f"fleet-slip evaluate --one-car {data.evaluated.group} --fleet NAME --rivals"


def claim(place: str, statement: str, criterion: str) -> Callable[[Judge], Claim]:
    """Make a claim of the function that decides it."""
    return lambda decide: Claim(place, statement, criterion, decide)


def verdict(holds: bool, figure: str, why: str) -> Verdict:
    """Return the verdict on a claim that can be tested."""
    return Verdict(Status.REPRODUCED if holds else Status.NOT_REPRODUCED, figure, why)


def not_testable(why: str) -> Verdict:
    """Return the verdict on a claim that cannot be tested."""
    return Verdict(Status.NOT_TESTABLE, "", why)


@dataclass(frozen=True)
class Known:
    """Figures of an estimator on a drive that all are there."""

    correlation: float
    mean_deg: float
    std_deg: float
    rmse_deg: float
    p99_deg: float
    max_deg: float
    coverage: float


def known(data: ReportData, scenario: str, estimator: str | None = None) -> Known:
    """Return the figures of an estimator, the paper's choice by default, on a drive.

    Raises `NotEvaluatedError` if there are none.
    """
    name = estimator or data.choice
    return complete(data.evaluated.figures(scenario, name), f"{name} on {scenario}")


def require_known(data: ReportData, *scenarios: str) -> None:
    """Raise `NotEvaluatedError` if the paper's choice has no figures on one of the drives."""
    for scenario in scenarios:
        known(data, scenario)


def complete(found: ErrorFigures | None, what: str) -> Known:
    """Return figures that are all there. Raises `NotEvaluatedError` otherwise."""
    if (
        found is None
        or found.correlation is None
        or found.error_mean_deg is None
        or found.error_std_deg is None
        or found.rmse_deg is None
        or found.error_p99_deg is None
        or found.error_max_deg is None
    ):
        raise NotEvaluatedError(what)
    return Known(
        found.correlation,
        found.error_mean_deg,
        found.error_std_deg,
        found.rmse_deg,
        found.error_p99_deg,
        found.error_max_deg,
        found.coverage,
    )
