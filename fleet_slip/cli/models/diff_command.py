"""Two model versions beside each other: the command diff, and score --against."""

from typing import Any

import typer

from fleet_slip.cli.models.version_commands import Reference
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.models.diff import Difference, Term
from fleet_slip.models.estimates.score import score as score_rows
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.warehouse.condition import Condition, parse_condition, row_columns
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of


def diff(context: typer.Context, one: Reference, other: Reference, json: Json = False) -> None:
    """Tell two model versions apart: their data, signals, coefficients and figures.

    Example: **fleet-slip diff waterford@1 waterford@2**
    """
    found = context.obj.diff(one, other)
    if json:
        print_json(found)
    else:
        _print_difference(found)


def _print_difference(found: Difference) -> None:
    one, other = found.one.reference, found.other.reference
    if not found.facts and all(term.same for term in found.terms):
        say(f"{one} and {other} are the same estimator from the same data")
        return
    terms = []
    for term in found.terms:
        here, there = _coefficients(term)
        terms.append([term.signal, term.unit, here, "the same" if term.same else there])
    print_table("", ["signal", "unit", one, other], terms, left=2)
    if found.drives is not None:
        shared = found.drives
        say(
            f"drives: {shared.both:,} made both, {shared.only_one:,} only {one}, "
            f"{shared.only_other:,} only {other}"
        )
    rows = [
        [name.rpartition(".")[2].replace("_", " "), _shown(a), _shown(b)]
        for name, (a, b) in found.facts.items()
        if not name.endswith("sha256")  # for machines: --json
    ]
    print_table("", ["what differs", one, other], rows, left=3)


def _coefficients(term: Term) -> list[str]:
    """Return the two coefficients of a term, with more digits where few would hide a difference."""
    values = (term.one, term.other)
    short = ["" if value is None else f"{value:.6g}" for value in values]
    return short if term.same or short[0] != short[1] else [repr(value) for value in values]


def _shown(value: Any) -> str:
    match value:
        case None:
            return ""
        case dict():
            return ", ".join(f"{name} {inner}" for name, inner in value.items())
        case float():
            return f"{value:.6g}"
        case _:
            return str(value)


def score_against(
    warehouse: Warehouse, one: ModelVersion, other: ModelVersion, rows: Condition, json: bool
) -> None:
    """Print the figures of two versions on the rows that have the signals of both."""
    needed = {*one.manifest.columns, *other.manifest.columns}
    complete = " AND ".join(f"{name} IS NOT NULL" for name in sorted(needed))
    both = rows & parse_condition(complete, row_columns())
    first, second = (
        score_rows(warehouse, version.manifest, both).as_dict() for version in (one, other)
    )
    if json:
        models = {one.reference: first, other.reference: second}
        print_json({"cohort": rows.text, "models": models})
        return
    print_table(
        f"{one.reference} and {other.reference} on the same {number_of(first['rows'], 'row')}",
        ["figure", one.reference, other.reference, "difference"],
        [
            [
                name.replace("_deg", ", deg").replace("_", " "),
                *(f"{number:,}" if isinstance(number, int) else f"{number:.4f}" for number in pair),
                f"{pair[0] - pair[1]:+.4f}",
            ]
            for name, pair in ((name, (first[name], second[name])) for name in first)
            if name != "rows" and None not in pair and any(pair)
        ],
    )
