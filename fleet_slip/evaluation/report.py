"""The report: one static page without a request to anywhere, and its figures as files."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from jinja2 import meta

from fleet_slip.base import number_of
from fleet_slip.evaluation.pictures import draw_pictures
from fleet_slip.evaluation.report_data import (
    BLOCK_S,
    DRAWN_FILTERS,
    ReportData,
    blocks_won,
    difference,
    gather,
)
from fleet_slip.evaluation.report_tables import TEXTS, expression, read_toml, tables
from fleet_slip.evaluation.scenarios import PAPER_TABLE_TWO, ErrorFigures
from fleet_slip.export.costs import describe_costs
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.drawing import Picture, draw, png_file, svg_file
from fleet_slip.pages.page import Tile, count, degrees, fill_in, listed
from fleet_slip.regression.choice import Winner
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.folder import Folder
from fleet_slip.warehouse.tables import Warehouse

# What claims are judged by, each under the name that it has in `claims.toml`.

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

    def __getitem__(self, name: str) -> Any:
        """Return a fact, or a scenario's figures of the choice. Raises `NotEvaluatedError`."""
        if name in self.data.shipped:
            return self.figures(name, self.data.choice)
        if name not in NAMES:
            raise KeyError(f"claims.toml names {name!r}, which is neither a fact nor a scenario")
        fact = getattr(self, name)
        return fact if name in FUNCTIONS else fact()

    def figures(self, scenario: str, estimator: str) -> Any:
        """Return the error figures of an estimator over a whole drive, all of which are there."""
        return _complete(self._evaluated.figures(scenario, estimator), f"{estimator} on {scenario}")

    def unstable(self, scenario: str) -> list[str]:
        """Return when the car is unstable in a drive."""
        found = self._evaluated.stretches(scenario, "unstable")
        return [f"{begin:.0f}\N{EN DASH}{end:.0f} s" for begin, end in found]

    def scenarios(self) -> Mapping[str, Mapping[str, Any]]:
        """Return what the evaluation says of each scenario."""
        return self._evaluated.scenarios

    def models(self) -> Mapping[str, str]:
        """Return the estimator's name of each model of Table I."""
        return self._evaluated.models

    def ordering(self) -> Any:
        """Return what the order of the variables is worth."""
        return self.data.ordering

    def block_s(self) -> str:
        """Return the length of a block of a drive."""
        return f"{BLOCK_S:g}"

    def fleets(self) -> dict[str, Any]:
        """Compare the models of a fleet with those of one car on cars of other classes."""
        scenarios = self._evaluated.scenarios
        if "nominal" not in scenarios:
            raise NotEvaluatedError("nominal drive")
        rows = [
            row
            for row in self._evaluated.rows("comparisons")
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
        models = self._evaluated.models.items()
        errors = {name: self.figures("nominal", one).rmse_deg for name, one in models}
        near = [error for name, error in errors.items() if name != "1"]
        return {
            "rmse_deg": errors,
            "reached": all(e <= math.hypot(*PAPER_TABLE_TWO[name]) for name, e in errors.items()),
            "spread_deg": max(near) - min(near),
        }

    def blocks_won(self) -> dict[str, int]:
        """Return in how many blocks of the nominal drive each model is best."""
        models = self._evaluated.models
        for estimator in models.values():
            self.figures("nominal", estimator)
        won = blocks_won(self.data.runs["nominal"], list(models.values()))
        return {name: won[estimator] for name, estimator in models.items()}

    def unstable_section(self) -> dict[str, Any]:
        """Return the figures within and without the unstable section of the slippery drive."""
        what = "unstable section at an adhesion of 0.4"
        choice, part = self.data.choice, self._evaluated.part
        return {
            "inside": _complete(part(SLIPPERY, choice, "inside", "unstable"), what),
            "outside": _complete(part(SLIPPERY, choice, "outside", "unstable"), what),
        }

    def while_stable(self) -> Any:
        """Return the figures of the slippery drive where the car is stable."""
        outside = self._evaluated.part(SLIPPERY, self.data.choice, "outside", "unstable")
        return self[SLIPPERY] if outside is None else _complete(outside, "stable section")

    def further_drives(self) -> dict[str, float]:
        """Return the RMSE over the angle's std in each drive beyond the paper without a failure."""
        shares = {
            one["description"]: self[name].rmse_deg / one["truth"]["sideslip_std_deg"]
            for name, one in self._evaluated.scenarios.items()
            if one["paper"] is None and not one["failures"]
        }
        if not shares:
            raise NotEvaluatedError("drive beyond the paper")
        return shares

    def worst(self) -> dict[str, Any]:
        """Return the largest error in the paper's drives, and where it is."""
        errors = [
            (self[name].error_max_deg, one["description"])
            for name, one in self._evaluated.scenarios.items()
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

    def over_gps_noise(self) -> str:
        """Tell at which noise of GPS the tuned filter is as accurate as the regression."""
        sweep = self._evaluated.gps_noise
        if sweep is None:
            return ""
        levels = [level["velocity_std_mps"] for level in sweep["levels"]]
        span = f"noises of GPS velocity from {min(levels):g} to {max(levels):g} m/s"
        equal = sweep["equal_at_mps"].get("kalman_tuned", {}).get(self.data.choice)
        if equal is None:
            return f"Among {span} there is none at which both are equal. "
        return (
            f"It hangs on GPS: of {span}, the tuned filter is better below {equal:.3f} and the "
            "regression above. "
        )

    def in_outages(self) -> list[str]:
        """Tell the errors while satellite navigation is out."""
        told = []
        for name, place in OUTAGES.items():
            ours, theirs = (
                self._evaluated.part(name, estimator, "inside", "gps_outage")
                for estimator in (self.data.choice, "kalman_tuned")
            )
            if ours and theirs:
                told.append(f"{place} {degrees(theirs.rmse_deg)} against {degrees(ours.rmse_deg)}")
        return told


FUNCTIONS = ("figures", "unstable")
"""Facts that a claim calls itself."""

NAMES = frozenset(name for name in vars(Facts) if not name.startswith("_"))


def _smallest(winner: Winner) -> str:
    if winner.model is winner.best:
        return f"No model with fewer signals comes near model {winner.best.name}"
    gain = next(s for s in winner.shortfalls if s.model is winner.model)
    return (
        f"Model {winner.model.name}, with {len(winner.model.signals)} signals, has an RMSE that is "
        f"larger by {gain}: {'real' if gain.real else 'not real'}, and negligible"
    )


def _complete(found: ErrorFigures | None, what: str) -> Any:
    """Return figures that are all there. Raises `NotEvaluatedError` otherwise."""
    if found is None or None in vars(found).values():
        raise NotEvaluatedError(what)
    return found


# Judges the paper's claims, which `claims.toml` lists, by the report's data.


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


SECTIONS = {"paper": "figure-", "roads": "road-", "fleet": "fleet-"}
"""What the keys of a section's pictures begin with."""

TABLES_IN = {
    "tables": ("table-1", "table-2", "distances", "targets", "targets-filter"),
    "further": (
        "without-label", "own-car", "scenarios", "standings", "limits", "fleets",
    ),
    "coefficients": ("coefficients",),
}  # fmt: skip
"""The tables of each section, by their names in `tables.toml`."""


def render(data: ReportData, shown: Sequence[Picture]) -> str:
    """Return the page."""
    drawn = [draw(one) for one in shown]
    claims = judge_claims(data)
    return fill_in(
        "report.html.j2",
        version=data.version,
        evaluation=data.evaluated.document,
        **{
            section: [one for one in drawn if one.picture.key.startswith(prefix)]
            for section, prefix in SECTIONS.items()
        },
        beyond=[one for one in drawn if not one.picture.key.startswith((*SECTIONS.values(),))],
        **{
            section: [one for name in names for one in tables(data, name)]
            for section, names in TABLES_IN.items()
        },
        tiles=_tiles(data, claims),
        claims=claims,
        tally=_tally(claims),
        statuses=list(Status),
        missing=[one for one in data.shipped if one not in data.evaluated.scenarios],
        provenance=_provenance(data),
        configs=data.configs,
        commands=_commands(data),
    )


def _tally(claims: Sequence[Judged]) -> dict[Status, int]:
    counted = Counter(one.status for one in claims)
    return {status: counted[status] for status in Status}


def _tiles(data: ReportData, claims: Sequence[Judged]) -> list[Tile]:
    tally = _tally(claims)
    cohort = data.trained.selection.cohort
    tiles = [
        Tile(
            f"{tally[Status.REPRODUCED]} of "
            f"{tally[Status.REPRODUCED] + tally[Status.NOT_REPRODUCED]}",
            f"testable claims reproduced; {tally[Status.NOT_TESTABLE]} cannot be tested here",
        ),
        Tile(
            count(cohort.rows),
            f"training rows of {number_of(data.version.manifest.trained_on.drives, 'drive')}",
        ),
    ]
    reported, chosen = (
        None if found is None else found.error_std_deg
        for found in (
            data.evaluated.figures("nominal", data.version.reference),
            data.evaluated.figures("nominal", data.choice),
        )
    )
    if reported is not None and chosen is not None:
        number = data.choice_number
        tiles.append(
            Tile(
                degrees(reported),
                f"error std of {data.version.reference} on the nominal drive; "
                f"of model {number} {degrees(chosen)}, in the paper "
                f"{degrees(PAPER_TABLE_TWO[number][1])}",
            )
        )
    return tiles


def _provenance(data: ReportData) -> list[tuple[str, str]]:
    manifest = data.version.manifest
    trained = manifest.trained_on
    cohort = data.trained.selection.cohort
    now = f"logs {cohort.logs_version}, grams {cohort.grams_version}"
    return [
        ("model version", data.version.reference),
        ("its SHA-256", data.version.sha256),
        ("signals", ", ".join(manifest.signals)),
        ("cohort", trained.cohort),
        ("trained on", f"{number_of(trained.drives, 'drive')}, {count(trained.rows)} rows"),
        (
            "table versions",
            f"logs {trained.logs_version}, grams {trained.grams_version} when it was published; "
            f"{now} now",
        ),
        ("model list", f"{manifest.selected_by.model_list}, {manifest.selected_by.config_sha256}"),
        ("evaluation", f"evaluations/{data.evaluated.document.number}.json"),
        ("its SHA-256", data.evaluated.document.sha256),
        ("package", f"fleet-slip {data.evaluated.document.content['package_version']}"),
    ]


def _commands(data: ReportData) -> list[str]:
    reference = data.version.reference
    fleets = dict.fromkeys(
        row["fleet"].rpartition("/")[0] for row in data.evaluated.rows("comparisons")
    )
    options = "".join(f" --fleet {name}" for name in fleets)
    return [
        *(f"fleet-slip run --campaign {name}" for name in data.campaigns),
        f"fleet-slip evaluate {reference}{options}",
        f"fleet-slip report {reference}",
    ]


PAGE = "report.html"
FIGURES = "figures"


@dataclass(frozen=True)
class Written:
    """What was written."""

    page: str
    size_bytes: int
    figures: int

    @property
    def figures_folder(self) -> str:
        """Where the figures are as files."""
        return f"{self.page.removesuffix(PAGE)}{FIGURES}"


def write_report(warehouse: Warehouse, version: ModelVersion, output: Folder) -> Written:
    """Write the report into a folder, the page last. Raises `DataError` if not evaluated."""
    data = gather(warehouse, version)
    shown = draw_pictures(data)
    page = render(data, shown).encode("utf-8")
    for picture in shown:
        output.put(f"{FIGURES}/{picture.key}.svg", svg_file(picture).encode("utf-8"))
        output.put(f"{FIGURES}/{picture.key}.png", png_file(picture))
    output.put(PAGE, page)
    return Written(f"{output}/{PAGE}", len(page), len(shown))
