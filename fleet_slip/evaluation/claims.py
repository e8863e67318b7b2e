"""The paper's claims, which `claims.toml` lists, judged by what a report knows."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined, meta

from fleet_slip.evaluation.judge import ErrorFigures
from fleet_slip.evaluation.kept import (
    BLOCK_S,
    DRAWN_FILTERS,
    PAPER_TABLE_TWO,
    ReportData,
    blocks_won,
    difference,
)
from fleet_slip.export.costs import describe_costs
from fleet_slip.pages import page
from fleet_slip.pages.page import degrees, listed
from fleet_slip.regression.choice import Winner
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ

TEXTS = Environment(undefined=StrictUndefined, keep_trailing_newline=True)  # noqa: S701 - no HTML
TEXTS.filters |= {
    one.__name__: one
    for one in (page.count, page.degrees, page.listed, page.number, page.percent, page.scientific)
}

SLIPPERY = "adhesion_0_4"
OUTAGES = {"gps_urban": "between high buildings", "gps_tunnel": "in the tunnel"}


class NotEvaluatedError(LookupError):
    """The evaluation lacks what a claim needs; the message says what."""


class Facts:
    """The facts of one report, worked out when a claim asks for them."""

    def __init__(self, data: ReportData) -> None:
        """Take what the report knows."""
        self.data = data
        self._evaluated = data.evaluated
        self.scenarios = data.evaluated.scenarios
        self.models = data.evaluated.models
        self.ordering = data.ordering
        self.block_s = f"{BLOCK_S:g}"

    def __getitem__(self, name: str) -> Any:
        """Return a fact, or a scenario's figures of the choice. Raises `NotEvaluatedError`."""
        if name in self.data.shipped:
            return self.figures(name, self.data.choice)
        if name not in NAMES:
            raise KeyError(f"claims.toml names {name!r}, which is neither a fact nor a scenario")
        fact = getattr(self, name)
        return fact if name in AS_THEY_ARE else fact()

    def figures(self, scenario: str, estimator: str) -> Any:
        """Return the error figures of an estimator over a whole drive, all of which are there."""
        return _complete(self._evaluated.figures(scenario, estimator), f"{estimator} on {scenario}")

    def unstable(self, scenario: str) -> list[str]:
        """Return when the car is unstable in a drive."""
        found = self._evaluated.stretches(scenario, "unstable")
        return [f"{begin:.0f}\N{EN DASH}{end:.0f} s" for begin, end in found]

    def fleets(self) -> dict[str, Any]:
        """Compare the models of a fleet with those of one car on cars of other classes."""
        scenarios = self.scenarios
        if "nominal" not in scenarios:
            raise NotEvaluatedError("nominal drive")
        rows = [
            row
            for row in self._evaluated.document.content["comparisons"]
            if scenarios[row["scenario"]]["vehicle_model"] != scenarios["nominal"]["vehicle_model"]
        ]
        if not rows:
            raise NotEvaluatedError("fleet-trained model on cars of other classes")
        change = sum(row["fleet_rmse_deg"] - row["one_car_rmse_deg"] for row in rows)
        better = sum(row["better"] == row["fleet"] for row in rows)
        return {"better": better, "cases": len(rows), "change_deg": change / len(rows)}

    def board(self) -> dict[str, Any]:
        """Return what an estimate costs on board."""
        version = self.data.version
        return {
            "signals": len(self._evaluated.estimators[self.data.choice]["signals"]),
            "drives": version.manifest.trained_on.drives,
            "version": version.reference,
            "costs": describe_costs(version.manifest),
        }

    def training(self) -> dict[str, Any]:
        """Return the training rows, and how the models of Table I do on them."""
        selection = self.data.trained.selection
        return {
            "rows": selection.cohort.rows,
            "rate_hz": SAMPLE_RATE_HZ,
            "ranked": sorted(selection.models, key=lambda one: one.correlation, reverse=True),
            "correlation": {model.name: model.correlation for model in selection.models},
            "smallest": _smallest(selection.winner),
        }

    def table_two(self) -> dict[str, Any]:
        """Compare the models' errors on the nominal drive with Table II."""
        models = self.models.items()
        errors = {name: self.figures("nominal", one).rmse_deg for name, one in models}
        near = [error for name, error in errors.items() if name != "1"]
        return {
            "rmse_deg": errors,
            "reached": all(e <= math.hypot(*PAPER_TABLE_TWO[name]) for name, e in errors.items()),
            "spread_deg": max(near) - min(near),
        }

    def blocks_won(self) -> dict[str, int]:
        """Return in how many blocks of the nominal drive each model is best."""
        models = self.models
        for estimator in models.values():
            self.figures("nominal", estimator)
        won = blocks_won(self.data.runs["nominal"], list(models.values()))
        return {name: won[estimator] for name, estimator in models.items()}

    def unstable_section(self) -> dict[str, Any]:
        """Return the figures within and without the unstable section of the slippery drive."""
        what = "unstable section at an adhesion of 0.4"
        choice, part = self.data.choice, self._evaluated.figures
        return {
            "inside": _complete(part(SLIPPERY, choice, "inside", "unstable"), what),
            "outside": _complete(part(SLIPPERY, choice, "outside", "unstable"), what),
        }

    def while_stable(self) -> Any:
        """Return the figures of the slippery drive where the car is stable."""
        outside = self._evaluated.figures(SLIPPERY, self.data.choice, "outside", "unstable")
        return self[SLIPPERY] if outside is None else _complete(outside, "stable section")

    def further_drives(self) -> dict[str, float]:
        """Return the RMSE over the angle's std in each drive beyond the paper without a failure."""
        shares = {
            one["description"]: self[name].rmse_deg / one["truth"]["sideslip_std_deg"]
            for name, one in self.scenarios.items()
            if one["paper"] is None and not one["failures"]
        }
        if not shares:
            raise NotEvaluatedError("drive beyond the paper")
        return shares

    def worst(self) -> dict[str, Any]:
        """Return the largest error in the paper's drives, and where it is."""
        errors = [
            (self[name].error_max_deg, one["description"])
            for name, one in self.scenarios.items()
            if one["paper"]
        ]
        if not errors:
            raise NotEvaluatedError("drive of the paper")
        largest, where = max(errors)
        return {"error_deg": largest, "drive": where}

    def against(self) -> dict[str, Any]:
        """Test the difference of the squared errors of filters and regression, block by block."""
        for name in (self.data.choice, *DRAWN_FILTERS):
            self.figures("nominal", name)
        run, choice = self.data.runs["nominal"], self.data.choice
        return {name: difference(run, choice, name) for name in DRAWN_FILTERS}

    def in_outages(self) -> list[str]:
        """Tell the errors while satellite navigation is out."""
        found = []
        for name, place in OUTAGES.items():
            ours, theirs = (
                self._evaluated.figures(name, estimator, "inside", "gps_outage")
                for estimator in (self.data.choice, "kalman_tuned")
            )
            if ours and theirs:
                found.append(f"{place} {degrees(theirs.rmse_deg)} against {degrees(ours.rmse_deg)}")
        return found


AS_THEY_ARE = ("figures", "unstable", "scenarios", "models", "ordering", "block_s")
"""Facts that a claim calls itself, or that the evaluation has."""

NAMES = frozenset({*AS_THEY_ARE, *(name for name in vars(Facts) if not name.startswith("_"))})


def _smallest(winner: Winner) -> str:
    if winner.model is winner.best:
        return f"No model with fewer signals comes near model {winner.best.name}"
    gain = next(s for s in winner.gaps if s.model is winner.model)
    return (
        f"Model {winner.model.name}, with {len(winner.model.signals)} signals, has an RMSE that is "
        f"larger by {gain}: {'real' if gain.is_significant else 'not real'}, and negligible"
    )


def _complete(found: ErrorFigures | None, what: str) -> Any:
    """Return figures that are all there. Raises `NotEvaluatedError` otherwise."""
    if found is None or None in vars(found).values():
        raise NotEvaluatedError(what)
    return found


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


_TABLE = tomllib.loads((files(__package__) / "claims.toml").read_text(encoding="utf-8"))
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
        holds = TEXTS.compile_expression(claim.holds, undefined_to_none=False)
        held = holds(**_names(f"{{{{ {claim.holds} }}}}", facts))
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
