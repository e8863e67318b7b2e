"""Judges the paper's claims, which `claims.toml` lists, by the report's data."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from jinja2 import meta

from fleet_slip.comparison.evaluation.targets import PAPER_TABLE_TWO
from fleet_slip.comparison.report.facts import Facts, NotEvaluatedError
from fleet_slip.comparison.report.report_data import ReportData
from fleet_slip.comparison.report.texts import TEXTS, expression, read_toml
from fleet_slip.pages.page_parts import listed


class Status(StrEnum):
    """What became of a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_TESTABLE = "not testable here"


@dataclass(frozen=True)
class Claim:
    """One statement of the paper; the head of `claims.toml` says what the fields are."""

    place: str
    statement: str
    criterion: str
    why: str
    holds: str | None = None
    figure: str = ""


@dataclass(frozen=True)
class Judged:
    """A claim with its criterion and how it turned out: what we found, and what it is due to."""

    claim: Claim
    criterion: str
    status: Status
    figure: str
    why: str


_TABLE = read_toml("claims.toml")
LIMITS: Mapping[str, float] = _TABLE.pop("limits")
CLAIMS: Mapping[str, Claim] = {name: Claim(**table) for name, table in _TABLE.items()}
"""In the paper's order."""


def judge_claims(data: ReportData) -> tuple[Judged, ...]:
    """Judge all claims."""
    facts = Facts(data)
    return tuple(judge(claim, facts) for claim in CLAIMS.values())


def judge(claim: Claim, facts: Facts) -> Judged:
    """Judge a claim; it is not testable where the evaluation lacks what it needs."""

    def not_testable(why: str) -> Judged:
        return Judged(claim, criterion, Status.NOT_TESTABLE, "", why)

    criterion = _filled(claim.criterion, facts)
    evaluated = facts.data.evaluated
    absent = [name for name in PAPER_TABLE_TWO if name not in evaluated.models]
    if absent:
        return not_testable(
            "The drives that the model was trained on lack signals of model "
            f"{listed(absent)} of Table I, which the paper's statements are about."
        )
    try:
        if claim.holds is None:
            return not_testable(_filled(claim.why, facts))
        held = expression(claim.holds)(_names(f"{{{{ {claim.holds} }}}}", facts))
        figure, why = _filled(claim.figure, facts), _filled(claim.why, facts)
    except NotEvaluatedError as lacking:
        return not_testable(
            f"The evaluation has no {lacking}. Run: fleet-slip evaluate "
            f"{evaluated.group} --fleet NAME"
        )
    status = Status.REPRODUCED if held else Status.NOT_REPRODUCED
    return Judged(claim, criterion, status, figure, why)


def _filled(template: str, facts: Facts) -> str:
    return TEXTS.from_string(template).render(_names(template, facts))


def _names(template: str, facts: Facts) -> dict[str, Any]:
    """Return all that a template names, looked up in the order in which it stands there."""
    names = meta.find_undeclared_variables(TEXTS.parse(template))
    return {
        name: LIMITS[name] if name in LIMITS else facts[name]
        for name in sorted(names, key=template.index)
    }
