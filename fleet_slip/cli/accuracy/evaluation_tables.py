"""What `evaluate` prints for people: who wins each test drive, and all tables of its document."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fleet_slip.cli.output import cell, print_line, print_table, print_text, stdout
from fleet_slip.words import number_of

PLACES = ("inside", "outside")
"""Of an unstable section."""


def print_evaluation(content: dict[str, Any]) -> None:
    """Print the tables of an evaluation."""
    groups: dict[str, list[str]] = {}
    for name, about in content["estimators"].items():
        groups.setdefault(about["group"], []).append(name)
    for group, names in groups.items():
        if content["estimators"][names[0]]["kind"] == "regression":
            title = f"{group}: RMSE, standard deviation and mean of the error in deg, correlation"
            _print_group(content, title, names, _full_cell, 25)
        else:
            _print_group(content, f"{group}: RMSE in deg", names, _rmse_cell, 12)
    print_ranking(content["ranking"])
    _print_gps_noise(content["gps_noise"])
    _print_sections(content)
    _print_checks(content["checks"])
    _print_comparisons(content["comparisons"])


def _print_group(
    content: dict[str, Any],
    title: str,
    names: Sequence[str],
    figures: Callable[[dict[str, Any]], str],
    width: int,
) -> None:
    """Print a table of estimators; as many tables as the terminal's width makes of it."""
    at_once = max(1, (stdout().width - NAMES_WIDTH) // (width + 2))
    for first in range(0, len(names), at_once):
        shown = names[first : first + at_once]
        print_table(
            f"\n{title}{', continued' if first else ''}",
            ["scenario", "side-slip", *(heading(name) for name in shown)],
            [
                [
                    one["name"],
                    f"{one['truth']['sideslip_std_deg']:.2f}",
                    *(figures(one["results"][name]) for name in shown),
                ]
                for one in content["scenarios"]
            ],
        )


NAMES_WIDTH = 33
"""Of the columns with a scenario's name and its side-slip."""


def heading(name: str) -> str:
    """Return an estimator's name in words, which a heading can wrap."""
    return name.rpartition("/")[2].replace("_", " ")


def _full_cell(result: dict[str, Any]) -> str:
    if result["error_std_deg"] is None:
        return "no estimate"
    figures = (
        f"{result['rmse_deg']:.3f} {result['error_std_deg']:.3f} {result['error_mean_deg']:+.3f}"
    )
    if result["correlation"] is not None:
        figures += f" {result['correlation']:.3f}"
    covered = result["coverage"]
    return figures if covered == 1 else f"{figures} ({covered:.0%})"


def _rmse_cell(result: dict[str, Any]) -> str:
    if result["rmse_deg"] is None:
        return "none"
    covered = result["coverage"]
    return f"{result['rmse_deg']:.3f}" + ("" if covered == 1 else f" ({covered:.0%})")


def print_ranking(ranking: dict[str, Any]) -> None:
    """Print who wins each test drive."""
    least, ours = ranking["least_coverage"], ranking["estimator"]
    print_table(
        f"\n{ours} wins {ranking['won']} of {ranking['drives']} test drives by RMSE, and is within "
        f"{ranking['close_ratio']:g} of the winner on {ranking['close']} others.\nAll compete that "
        f"need no GPS and estimate {least:.0%} of the rows. Drives that differ in GPS alone are "
        f"one. {ours}/3 is model 3 of Table I, trained on what {ours} was trained on.",
        ["scenario", "won by", "RMSE deg", f"{ours} deg", "ratio"],
        [
            [
                one["scenario"],
                one["winner"] or "",
                cell(one["winner_rmse_deg"], ".3f"),
                cell(one["rmse_deg"], ".3f"),
                cell(one["ratio"], ".2f"),
            ]
            for one in ranking["standings"]
            if one["same_as"] is None
        ],
        left=2,
    )


def _print_gps_noise(sweep: dict[str, Any] | None) -> None:
    if sweep is None:
        return
    names = list(sweep["levels"][0]["rmse_deg"])
    print_table(
        f"\n{sweep['scenario']}: RMSE in deg over the noise of GPS velocity, m/s, without outages",
        ["GPS noise", *map(heading, names)],
        [
            [
                f"{level['velocity_std_mps']:.3f}",
                *(cell(level["rmse_deg"][n], ".3f") for n in names),
            ]
            for level in sweep["levels"]
        ],
    )
    for regression, error in sweep["regressions"].items():
        equal = {name: sweep["equal_at_mps"][name][regression] for name in names}
        reached = ", ".join(f"{name} {at:.3f}" for name, at in equal.items() if at is not None)
        told = (
            f"which the filters reach at {reached} m/s" if reached else "reached at no such noise"
        )
        print_line(f"{regression}: {error:.3f}, {told}")


def _print_sections(content: dict[str, Any]) -> None:
    for one in content["scenarios"]:
        for section in one["sections"]:
            if section["name"] != "unstable":
                continue
            where = ", ".join(
                f"{s['from_s']:.1f}-{s['until_s']:.1f} s" for s in section["stretches"]
            )
            print_table(
                f"\n{one['name']}: unstable at {where}: {section['criterion']}",
                [
                    "estimator",
                    *(f"{name} {at}" for name in ("RMSE", "std", "corr.") for at in PLACES),
                ],
                [
                    [
                        name,
                        *(
                            cell(result[place]["unstable"][figure], ".3f")
                            for figure in ("rmse_deg", "error_std_deg", "correlation")
                            for place in PLACES
                        ),
                    ]
                    for name, result in one["results"].items()
                ],
            )


def _print_checks(checks: Sequence[dict[str, Any]]) -> None:
    if not checks:
        return
    print_table(
        "\nwhat the paper's scenarios ask for",
        ["requirement", "estimator", "found", "limit", ""],
        [
            [
                check["requirement"],
                check["estimator"],
                cell(check["found"], ".4f"),
                cell(check["limit"], ".4f"),
                "" if check["reached"] else "missed",
            ]
            for check in checks
        ],
        left=2,
    )
    for check in checks:
        if not check["reached"]:
            print_line(
                f"missed: {check['requirement']}, {check['estimator']}. {check['explanation']}"
            )


def _print_comparisons(comparisons: Sequence[dict[str, Any]]) -> None:
    for fleet in dict.fromkeys(row["fleet"].rpartition("/")[0] for row in comparisons):
        rows = [row for row in comparisons if row["fleet"].startswith(f"{fleet}/")]
        errors = {(row["scenario"], row["model"]): row for row in rows}
        models = list(dict.fromkeys(row["model"] for row in rows))
        one_car = rows[0]["one_car"].rpartition("/")[0]
        print_table(
            f"\nroot mean square error in deg, trained as {one_car} and as {fleet}; * the better",
            ["scenario", *models],
            [
                [name, *(_pair(errors.get((name, model))) for model in models)]
                for name in dict.fromkeys(row["scenario"] for row in rows)
            ],
        )


def _pair(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    first, second = f"{row['one_car_rmse_deg']:.3f}", f"{row['fleet_rmse_deg']:.3f}"
    better = row["better"] == row["one_car"]
    return f"{first}* {second} " if better else f"{first}  {second}*"


def print_summary(content: Mapping[str, Any], model: str) -> None:
    """Print a screen: a row a test drive, what stands out, and where the rest is."""
    print_ranking(content["ranking"])
    print_text("")
    ours = content["ranking"]["estimator"]
    for line in _extremes(content["scenarios"], ours):
        print_text(line)
    if checks := content["checks"]:
        missed = sum(not check["reached"] for check in checks)
        asked = number_of(len(checks), "requirement")
        print_text(f"Of {asked} of the paper's scenarios, its own models miss {missed}.")
    print_text(
        f"All estimators, sections and requirements: fleet-slip evaluate "
        f"{shlex.quote(model)} --all; for machines --json."
    )
    print_text(f"Pictures: fleet-slip report {shlex.quote(model)}")


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
