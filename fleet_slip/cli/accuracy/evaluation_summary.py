"""What `evaluate` prints first: who wins each test drive, and the story in a few lines."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from fleet_slip.cli.accuracy.evaluation_tables import print_ranking
from fleet_slip.cli.output import print_text
from fleet_slip.words import number_of


def print_summary(content: Mapping[str, Any], model: str) -> None:
    """Print a screen: a row a test drive, what stands out, and where the rest is."""
    print_ranking(content["ranking"])
    print_text("")
    ours = content["ranking"]["estimator"]
    for line in (*_extremes(content["scenarios"], ours), *_requirements(content["checks"])):
        print_text(line)
    print_text(
        f"All estimators, sections and requirements: fleet-slip evaluate --one-car "
        f"{shlex.quote(model)} --all; for machines --json."
    )
    print_text(f"Pictures: fleet-slip report --model {shlex.quote(model)}")


def _extremes(scenarios: Sequence[Mapping[str, Any]], ours: str) -> list[str]:
    """Return where our estimator is closest to the truth, furthest from it, and silent."""
    results = {one["name"]: one["results"][ours] for one in scenarios}
    sizes = {one["name"]: one["truth"]["sideslip_std_deg"] for one in scenarios}
    errors = {n: one["rmse_deg"] for n, one in results.items() if one["rmse_deg"] is not None}
    lines = []
    if errors:
        best, worst = min(errors, key=errors.__getitem__), max(errors, key=errors.__getitem__)
        lines.append(f"{ours} is closest to the truth on {best}: {errors[best]:.3f} deg.")
        lines.append(
            f"It is furthest from it on {worst}: {errors[worst]:.3f} deg, where the side-slip "
            f"varies by {sizes[worst]:.2f} deg."
        )
    partial = [
        f"{name} {one['coverage']:.0%}" for name, one in results.items() if one["coverage"] < 1
    ]
    if partial:
        lines.append(f"A sensor fails it on part of the rows; estimated: {', '.join(partial)}.")
    return lines


def _requirements(checks: Sequence[Mapping[str, Any]]) -> list[str]:
    if not checks:
        return []
    missed = sum(not check["reached"] for check in checks)
    asked = number_of(len(checks), "requirement")
    return [f"Of {asked} of the paper's scenarios, its own models miss {missed}."]
