"""Commands that evaluate: score on the rows of a cohort, evaluate on test drives."""

import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.base import needed, number_of
from fleet_slip.catalogue.facts import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.cli.app import record_run
from fleet_slip.cli.models import score_against
from fleet_slip.cli.options import Cohort, OnlyModel, Threads, Unexamined, complete_config
from fleet_slip.cli.output import (
    Json,
    cell,
    print_json,
    print_line,
    print_records,
    print_table,
    print_text,
    say,
    stdout,
)
from fleet_slip.cli.progress import progress
from fleet_slip.cli.selection import say_examined, say_without_information
from fleet_slip.errors import UsageError
from fleet_slip.models.score import Score, score_statement
from fleet_slip.resources import folder
from fleet_slip.storage.storage_errors import storage_errors

if TYPE_CHECKING:
    from fleet_slip.evaluation.blind import BlindRow
    from fleet_slip.evaluation.identify import Identified
    from fleet_slip.evaluation.scenarios import ErrorFigures


# What `evaluate` prints for people: who wins each test drive, and all tables of its document.

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
    print_records(
        f"\n{ours} wins {ranking['won']} of {ranking['drives']} test drives by RMSE, and is within "
        f"{ranking['close_ratio']:g} of the winner on {ranking['close']} others.\nAll compete that "
        f"need no GPS and estimate {least:.0%} of the rows. Drives that differ in GPS alone are "
        f"one. {ours}/3 is model 3 of Table I, trained on what {ours} was trained on.",
        f"scenario|won by|RMSE deg|{ours} deg|ratio",
        "{scenario}|{winner}|{winner_rmse_deg:.3f}|{rmse_deg:.3f}|{ratio:.2f}",
        (one for one in ranking["standings"] if one["same_as"] is None),
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
    header = "requirement|estimator|found|limit|"
    row = "{requirement}|{estimator}|{found:.4f}|{limit:.4f}|{missed}"
    rows = ({**check, "missed": None if check["reached"] else "missed"} for check in checks)
    print_records("\nwhat the paper's scenarios ask for", header, row, rows, left=2)
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


# What `evaluate` prints of drives that nobody tuned to: blind ones, and measured ones left out.


def print_blind(rows: Sequence["BlindRow"], everything: bool) -> None:
    """Print how far estimators are off on blind drives: published models and filters, or all."""
    errors = {name: one.rmse_deg for name, one in rows[0].figures.items()}
    names = [
        name
        for name, rmse_deg in errors.items()
        if "@" in name.rpartition("/")[2]
        or (rmse_deg is not None and (everything or "/" not in name))
    ]
    names.sort(key=lambda name: ("@" not in name, errors[name] is None, errors[name]))
    shown = names if everything else names[:BLIND_NAMES]
    print_table(
        "Blind drives: RMSE in deg against the exact angle",
        ["drives", "m/s", "side-slip std", *map(heading, shown)],
        [
            [
                row.name.replace("_", " "),
                f"{row.speed_mps[0]:.0f} to {row.speed_mps[1]:.0f}",
                f"{row.sideslip_std_deg:.2f}",
                *(_blind_cell(row.figures[name]) for name in shown),
            ]
            for row in rows
            if everything or row.drives > 1
        ],
    )
    for name in names:
        if errors[name] is None:
            print_text(
                f"{name} has no estimate on any of them: it may need what a car's own drives tell, "
                "and nobody knows these cars."
            )
    if not everything:
        print_text("Every drive, and all estimators: --all; for machines --json.")


BLIND_NAMES = 5
"""Estimators of the table that is printed first: published models, then the best of the others."""


def _blind_cell(one: "ErrorFigures") -> str:
    if one.rmse_deg is None:
        return "none"
    return f"{one.rmse_deg:.3f}" + ("" if one.coverage == 1 else f" ({one.coverage:.0%})")


def print_own_car(content: Mapping[str, Any], everything: bool) -> None:
    """Print figures on measured drives, the best estimator first; with all of them by drive."""
    estimators = content["estimators"]
    print_records(
        f"{content['cohort']}: each quarter of the {content['parts_of']} left out in turn, "
        f"{number_of(len(content['drives']), 'drive')}",
        "estimator|knows|RMSE deg|mean|std|correlation|rows",
        "{name}|{told}|{rmse_deg:.3f}|{error_mean_deg:+.3f}|{error_std_deg:.3f}|"
        "{correlation:.3f}|{coverage:.0%}",
        ({**one, "name": name} for name, one in estimators.items()),
        left=2,
    )
    if content["vehicle"] is None:
        print_text(
            "No filter competes: no vehicle file is known. Make one: fleet-slip identify, and name "
            "it with --vehicle."
        )
    if everything:
        print_table(
            "RMSE in deg by drive",
            ["drive", *map(heading, estimators)],
            [
                [drive, *(cell(found[name], ".3f") for name in estimators)]
                for drive, found in content["drives"].items()
            ],
        )


FleetModels = Annotated[
    list[str] | None,
    typer.Option(help="Another model, to be compared with the first. May be repeated."),
]
Scenarios = Annotated[
    list[str] | None,
    typer.Option(
        "--scenario",
        help="A scenario of configs/scenarios, or a TOML file. May be repeated. Default: all.",
        autocompletion=complete_config("scenarios"),
        show_default=False,
    ),
]


def score(
    context: typer.Context,
    model: OnlyModel = None,
    cohort: Annotated[
        str | None,
        typer.Option(
            help="SQL condition on the view drives. Default: what the model was not trained on, or "
            "all if there is nothing else."
        ),
    ] = None,
    sql: Annotated[bool, typer.Option("--sql", help="Print the statement and do nothing.")] = False,
    against: Annotated[
        str | None,
        typer.Option(help="Another version of the model, such as champion, on the same rows."),
    ] = None,
    unexamined: Unexamined = False,
    json: Json = False,
) -> None:
    """Evaluate a model on the rows of a cohort: also the largest error and percentiles.

    Example: **fleet-slip score waterford --cohort "speed_factor > 0.9"**
    """
    version = context.obj.model(model)
    if sql:
        typer.echo(score_statement(version.manifest, cohort or ALL_DRIVES))
        return
    if against is not None:
        name = against if "@" in against else f"{version.manifest.name}@{against}"
        other = context.obj.model(name)
        rows, examined = context.obj.scored_rows(cohort, unexamined=unexamined)
        say_examined(str(examined))
        score_against(context.obj.warehouse, version, other, rows, json)
        return
    found: Score = context.obj.score(version, cohort, unexamined=unexamined)
    say_examined(found.examined)
    result = found.as_dict()
    if json:
        print_json({"model": version.reference, "cohort": cohort or ALL_DRIVES, **result})
        return
    print_table(
        f"{version.reference} on {number_of(result['rows'], 'row')}",
        ["figure", "value"],
        [
            [name.replace("_deg", ", deg").replace("_", " "), f"{value:.4f}"]
            for name, value in result.items()
            if name.startswith(("error", "rmse", "correlation")) and value is not None
        ],
    )
    say_without_information(found.rows_without, found.rows + found.rows_without)
    _say_trained(found, version.reference)


def _say_trained(found: Score, reference: str) -> None:
    """Say which drives made the model: on these its error is that of a fit."""
    if found.drives_trained is None:
        say(f"{reference} does not tell which drives made it: some of these may have.")
    elif found.drives_left_out:
        left = number_of(found.drives_left_out, "drive")
        say(f"left out: {left} of {found.drives:,} that {reference} was trained on.")
    elif found.drives_trained:
        say(
            f"{reference} was trained on {found.drives_trained:,} of these "
            f"{number_of(found.drives or 0, 'drive')}: there the error is that of the fit. New "
            f"drives: fleet-slip evaluate {reference}"
        )


@record_run
def evaluate(
    context: typer.Context,
    model: OnlyModel = None,
    fleet: FleetModels = None,
    scenario: Scenarios = None,
    blind: Annotated[
        bool,
        typer.Option(
            "--blind",
            help="Judge on roads, cars, weather and drivers that are drawn from the hash of the "
            "model's version, which nobody can have seen before it was published.",
        ),
    ] = False,
    cohort: Annotated[
        str | None,
        typer.Option(
            help="Evaluate on measured drives with a label instead: SQL condition on the view "
            "drives. What is fitted or tuned never saw the drives, or the part of one, that it is "
            "judged by.",
            show_default=False,
        ),
    ] = None,
    vehicle: Annotated[
        str | None,
        typer.Option(
            help="With --cohort: the car's file, for filters. Its mass and geometry suffice.",
            autocompletion=complete_config("vehicles"),
            show_default=False,
        ),
    ] = None,
    threads: Threads = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all estimators, sections and requirements.")
    ] = False,
    json: Json = False,
) -> None:
    """Evaluate models on the paper's test drives and on others; simulates those that are missing.

    Beside the model, those of Table I are evaluated, trained on its cohort.

    Prints who wins each test drive; all of it with --all. The results are kept as a JSON document
    below evaluations/ in the data root.

    Example: **fleet-slip evaluate waterford --scenario nominal**
    """
    model = model or context.obj.registry().only()
    if cohort is not None or vehicle is not None:
        if scenario or blind or cohort is None:
            raise UsageError(
                "--cohort judges measured drives, for filters in the car of --vehicle: leave out "
                "--scenario and --blind, and name a cohort."
            )
        measured = context.obj.evaluate_measured(
            model, cohort, fleet or (), vehicle=vehicle, threads=threads
        )
        if json:
            print_json({"number": measured.number, "sha256": measured.sha256, **measured.content})
        else:
            print_own_car(measured.content, everything)
            say(f"kept as evaluations/measured/{measured.number}.json")
        return
    if blind:
        if scenario:
            raise UsageError("--blind has drives of its own: leave out --scenario.")
        rows = context.obj.evaluate_blind(model, fleet or (), threads=threads)
        if json:
            print_json({"blind": [row.as_dict() for row in rows]})
        else:
            print_blind(rows, everything)
        return
    with progress("simulate scenarios", "rows") as show:
        kept = context.obj.evaluate(
            model,
            fleet or (),
            scenarios=scenario or (),
            threads=threads,
            progress=show,
        )
    content = dict(kept.content)
    if json:
        print_json({"number": kept.number, "sha256": kept.sha256, **content})
    else:
        if everything:
            print_evaluation(content)
        else:
            print_summary(content, model)
        say(f"kept as evaluations/{kept.number}.json")


# The command that identifies a car from labelled drives: identify.


def identify(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="What the car is to be called.")],
    mass: Annotated[float, typer.Option(help="Of the whole car, kg.", min=1)],
    front_axle: Annotated[
        float, typer.Option(help="From the centre of gravity to the front axle, m.", min=0.01)
    ],
    rear_axle: Annotated[float, typer.Option(help="To the rear axle, m.", min=0.01)],
    track: Annotated[float, typer.Option(help="m.", min=0.01)] = 1.55,
    height: Annotated[
        float, typer.Option(help="Of the centre of gravity above the road, m.", min=0.01)
    ] = 0.55,
    radius: Annotated[float, typer.Option(help="Rolling radius, m.", min=0.01)] = 0.315,
    front_drive: Annotated[
        float, typer.Option(help="Share of the drive torque in front.", min=0, max=1)
    ] = 1.0,
    cohort: Cohort = TRAINING_DRIVES,
    output: Annotated[
        Path | None, typer.Option(help="Write the vehicle file here.", show_default=False)
    ] = None,
    threads: Threads = None,
    json: Json = False,
) -> None:
    """Identify a car's tyres and inertia from labelled drives, as a vehicle file for filters.

    Given what scales and a tape measure say, an extended Kalman filter in the car is fitted to the
    label. Its error on drives that were left out stands beside it.

    Example: **fleet-slip identify hatchback --mass 1776 --front-axle 1.19 --rear-axle 1.44**
    """
    found: Identified = context.obj.cohort(cohort).identify(
        name,
        mass_kg=mass,
        front_axle_m=front_axle,
        rear_axle_m=rear_axle,
        track_m=track,
        height_m=height,
        rolling_radius_m=radius,
        front_drive_share=front_drive,
        threads=threads,
    )
    if output is not None:
        with storage_errors(output):
            output.write_text(found.as_toml(), encoding="utf-8")
    if json:
        print_json(found.as_dict())
        return
    shown = found.as_dict()
    print_table(
        f"{name}, identified from {number_of(found.drives, 'drive')}",
        ["what", "value"],
        [[what.replace("_", " "), f"{value:.4g}"] for what, value in shown["found"].items()],
    )
    held_out = shown["held_out_deg"]
    say(
        f"the extended Kalman filter in it errs by {shown['fit_deg']:.4f} deg on these drives"
        + ("." if held_out is None else f", and by {held_out:.4f} deg on those left out.")
    )
    if output is not None:
        say(f"written to {output}: a vehicle file, as in configs/vehicles.")


# Commands that show: report, watch, explore.


def report(
    context: typer.Context,
    model: OnlyModel = None,
    output: Annotated[
        Path | None,
        typer.Option(help="Folder. Default: report/ in the data root.", show_default=False),
    ] = None,
    json: Json = False,
) -> None:
    """Write one page that lays our figures beside the paper's, from the latest evaluation.

    The page needs nothing but itself; the same figures stand beside it as SVG and PNG files.

    Example: **fleet-slip report waterford**
    """
    written = context.obj.report(model, output)
    if json:
        print_json(written)
    else:
        say(
            f"{written.page}: {written.size_bytes / 1e6:.1f} MB, {written.figures} figures, "
            f"which are in {written.figures_folder} too"
        )


def watch(
    context: typer.Context,
    what: Annotated[
        str,
        typer.Argument(
            help="A scenario of configs/scenarios, the path of one, or a drive of the logs.",
            metavar="SCENARIO|DRIVE",
            autocompletion=complete_config("scenarios"),
            show_default=False,
        ),
    ],
    model: OnlyModel = None,
    output: Annotated[Path, typer.Option(help="The page, .html, which plays in a browser.")] = Path(
        "watch.html"
    ),
    begin: Annotated[float, typer.Option("--from", help="First second that is shown.")] = 0.0,
    until: Annotated[
        float | None, typer.Option(help="Last second. Default: the last.", show_default=False)
    ] = None,
    threads: Threads = None,
) -> None:
    """Show a drive: the car on its track, its true and its estimated angle, wheels and gates.

    The page is one file and needs no server.

    Example: **fleet-slip watch adhesion_0_4 --output slippery.html**
    """
    file = context.obj.watch(what, model, output, from_s=begin, until_s=until, threads=threads)
    from fleet_slip.pages.page import size  # noqa: PLC0415 - of the extra, which is there now

    say(f"{file}: {size(file.stat().st_size)}")


def explore(
    context: typer.Context,
    edit: Annotated[
        bool, typer.Option("--edit", help="Show the code, and let it be changed.")
    ] = False,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of this machine.", show_default=False)
    ] = None,
    headless: Annotated[
        bool, typer.Option("--headless", help="Open no browser; say the address.")
    ] = False,
) -> None:
    """Look at a data root in the browser: cohorts by mouse, error maps, coefficients, drift.

    A marimo notebook, which runs until it is interrupted.

    Example: **fleet-slip explore --headless**
    """
    with needed("explore", "the notebook"):
        import altair  # noqa: F401, PLC0415 - an extra
        import marimo  # noqa: F401, PLC0415
        import numba  # noqa: F401, PLC0415
    context.obj.warehouse.require()
    words = ["edit" if edit else "run", str(folder("jobs") / "explore.py")]
    words += [*(["--port", str(port)] if port else []), *(["--headless"] if headless else [])]
    command = [sys.executable, "-m", "marimo", *words, "--", "--root", str(context.obj.root)]
    os.execv(command[0], command)  # noqa: S606 - the notebook takes the place of this process
