"""The tables of the report, which `tables.toml` lists, filled in with its data."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

from jinja2 import Environment, StrictUndefined

from fleet_slip.base import number_of
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.evaluation.evaluate import LEAST_COVERAGE
from fleet_slip.evaluation.report_data import ReportData
from fleet_slip.evaluation.scenarios import FILTER_SCENARIOS, PAPER_TABLE_TWO
from fleet_slip.pages import page as text
from fleet_slip.pages.page import Cell, ReportTable, number, percent

# What the TOML files of the report are written in: Jinja, with numbers as pages show them.

TEXTS = Environment(undefined=StrictUndefined, keep_trailing_newline=True)  # noqa: S701 - no HTML
TEXTS.filters |= {
    one.__name__: one
    for one in (
        text.count, text.degrees, text.listed, text.number, text.percent, text.scientific, text.size
    )
}  # fmt: skip


def read_toml(name: str) -> dict[str, Any]:
    """Return the content of a TOML file of the report."""
    return tomllib.loads((files(__package__) / name).read_text(encoding="utf-8"))


def expression(source: str) -> Callable[..., Any]:
    """Return what computes an expression of words."""
    return TEXTS.compile_expression(source, undefined_to_none=False)


PAPER_TABLE_ONE = {"1": 0.9013, "2": 0.9534, "3": 0.9796, "4": 0.9911, "5": 0.9911}
"""Cross-validated correlations, Table I."""

SHOWN_MODELS = ("1", "2", "4", "5")
"""Model 3 hardly differs from model 2 anywhere."""

BOUNDS = read_toml("bounds.toml")
"""Of test drives that ship: by how much who knows no car, and who is told it, must err, deg."""


@dataclass(frozen=True)
class Column:
    """A column, or several; the head of `tables.toml` says what the fields are."""

    head: str
    cell: str
    each: str = "[none]"
    good: str = "false"
    miss: str = "false"
    value: str = "none"


@dataclass(frozen=True)
class Described:
    """A table, or several, of `tables.toml`."""

    caption: str
    rows: str
    columns: Sequence[Mapping[str, str]]
    key: str = ""
    each: str = "[none]"
    left: int = 1
    smallest: Literal["row", "column", ""] = ""
    note: str = ""


TABLES: Mapping[str, Described] = {
    name: Described(**content) for name, content in read_toml("tables.toml").items()
}


def tables(data: ReportData, name: str) -> list[ReportTable]:
    """Return what a table of `tables.toml` comes to: none, one or several."""
    about, words = TABLES[name], _words(data)
    return [
        _table(name, about, {**words, "it": it, "number": place + 1})
        for place, it in enumerate(expression(about.each)(words))
    ]


def _table(name: str, about: Described, words: Mapping[str, Any]) -> ReportTable:
    head: list[str] = []
    columns: list[list[tuple[Cell, Any]]] = []
    rows = list(expression(about.rows)(words))
    for column in (Column(**content) for content in about.columns):
        cell, good, miss, value = map(
            expression, (column.cell, column.good, column.miss, column.value)
        )
        for one in expression(column.each)(words):
            head.append(_filled(column.head, {**words, "one": one}))
            each = [{**words, "one": one, "row": row} for row in rows]
            columns.append(
                [
                    (Cell(cell(w), "good" if good(w) else "miss" if miss(w) else ""), value(w))
                    for w in each
                ]
            )
    lines = columns if about.smallest == "column" else zip(*columns, strict=True)
    marked = [_mark(line) for line in lines]
    return ReportTable(
        _filled(about.key or name, words),
        _filled(about.caption, words),
        head,
        list(zip(*marked, strict=True)) if about.smallest == "column" else marked,
        about.left,
        _filled(about.note, words),
    )


def _mark(line: Sequence[tuple[Cell, Any]]) -> list[Cell]:
    """Mark what has the smallest value of those that have one."""
    least = min((value for _, value in line if value is not None), default=None)
    return [
        Cell(cell.text, "good") if value is not None and value == least else cell
        for cell, value in line
    ]


def _filled(template: str, words: Mapping[str, Any]) -> str:
    return TEXTS.from_string(template).render(words)


def _words(data: ReportData) -> dict[str, Any]:
    """Return the words of `tables.toml`."""
    evaluated, manifest = data.evaluated, data.version.manifest
    learned = manifest.learned_from
    change_s = learned.change_s if learned else ()
    checks = evaluated.rows("checks")
    paper = [one for one in checks if one["scenario"] not in FILTER_SCENARIOS[1:]]
    found = {(one["requirement"], one["estimator"]): one for one in paper}
    nothing = {"found": None, "reached": None}

    def competing(scenario: str, estimator: str, figure: str, least: float) -> float | None:
        """Return a figure of who has estimates for at least such a share of a drive."""
        one = evaluated.figures(scenario, estimator)
        return getattr(one, figure) if one and one.coverage >= least else None

    def covered(scenario: str, estimator: str, figure: str, least: float) -> str:
        """Return a figure, with the share of the drive that it is of where that is less."""
        one = evaluated.figures(scenario, estimator)
        value = getattr(one, figure) if one else None
        if one is None or value is None or one.coverage >= least:
            return number(value)
        return f"{number(value)} ({percent(one.coverage)})"

    def times_bound(scenario: str, estimator: str) -> float | None:
        one = evaluated.figures(scenario, estimator)
        rmse_deg = one.rmse_deg if one else None
        return None if rmse_deg is None else rmse_deg / BOUNDS[scenario]["unknown"]

    return {
        "data": data,
        "evaluated": evaluated,
        "manifest": manifest,
        "selection": data.trained.selection,
        "by_speed": [data.by_speed] if data.by_speed else [],
        "label_noise": manifest.cross_validation.label_noise_deg,
        "change_s": [f"{t:g}" for t in (change_s if isinstance(change_s, tuple) else (change_s,))],
        "paper_one": PAPER_TABLE_ONE,
        "paper_two": PAPER_TABLE_TWO,
        "nominal": {
            name: one
            for name, estimator in evaluated.models.items()
            if (one := evaluated.figures("nominal", estimator)) and one.error_std_deg is not None
        },
        "plain": [one for one in paper if "below that of" not in one["requirement"]],
        "against": [one for one in checks if "below that of" in one["requirement"]],
        "check": lambda requirement, name: found.get((requirement, name), nothing),
        "misses": _misses,
        "shown": {
            **{f"model {k}": v for k, v in evaluated.models.items() if k in SHOWN_MODELS},
            **{
                name.removesuffix("_tuned").replace("_", " "): name
                for name in evaluated.of_kind("filter")
                if name.endswith("_tuned")
            },
        },
        "compared": compared(data),
        "own": compared(data),
        "bounds": BOUNDS,
        "bounded": [one for one in evaluated.scenarios if one in BOUNDS],
        "least_coverage": LEAST_COVERAGE,
        "competing": competing,
        "covered": covered,
        "times_bound": times_bound,
        "won": won(data),
        "fleets": _fleets(data),
        "signals": catalogue().signals,
        "number_of": number_of,
    }


def compared(data: ReportData) -> list[str]:
    """Return the estimators that stand beside each other: of Table I the paper's choice alone."""
    left_out = set(data.evaluated.models.values()) - {data.choice}
    return [name for name in data.evaluated.estimators if name not in left_out]


def won(data: ReportData) -> str:
    """Tell how many drives the published model wins; nothing in evaluations without a ranking."""
    found = data.evaluated.document.content.get("ranking")
    if found is None:
        return ""
    return (
        f"Among all without satellite navigation {found['estimator']} wins {found['won']} of "
        f"{found['drives']} drives, and comes within {found['close_ratio']} times the winner in "
        f"{found['close']} more; drives that differ in satellite navigation alone are one. "
    )


def _misses(checks: Sequence[Mapping[str, Any]]) -> str:
    missed = [one for one in checks if not one["reached"]]
    reached = f"{len(checks) - len(missed)} of {len(checks)} reached."
    told = [
        f"Missed by {one['estimator']} ({one['requirement']}): {one['explanation']}"
        for one in missed
    ]
    return " ".join([reached, *told])


def _fleets(data: ReportData) -> list[dict[str, Any]]:
    """Return for each fleet-trained model its errors beside those of the one-car model."""
    found: dict[str, dict[str, Any]] = {}
    for row in data.evaluated.rows("comparisons"):
        name, place = row["fleet"].rpartition("/")[0], (row["scenario"], row["model"])
        one = found.setdefault(name, {"name": name, "pairs": {}, "better": set(), "models": {}})
        one["models"][row["model"]] = None
        errors = (number(row[f"{whose}_rmse_deg"]) for whose in ("one_car", "fleet"))
        one["pairs"].setdefault(place[0], {})[place[1]] = " \N{RIGHTWARDS ARROW} ".join(errors)
        if row["better"] == row["fleet"]:
            one["better"].add(place)
    return [{**one, "cases": sum(map(len, one["pairs"].values()))} for one in found.values()]
