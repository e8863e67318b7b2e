"""Commands that evaluate: score on the rows of a cohort, evaluate on test drives."""

import os
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.base import needed, number_of
from fleet_slip.cli.options import command
from fleet_slip.cli.output import Json, print_answer, print_json, print_parts, say
from fleet_slip.cli.progress import progress
from fleet_slip.errors import UsageError
from fleet_slip.rendering import Part, TextTable
from fleet_slip.resources import folder
from fleet_slip.storage.storage_errors import storage_errors

if TYPE_CHECKING:
    from fleet_slip.evaluation.identify import Identified
    from fleet_slip.evaluation.report import Written


# What `evaluate` prints for people: a screen, and with --all the errors of all on every drive.

BLIND_NAMES = 5
"""Estimators of the table that is printed first: published models, then the best of the others."""


def evaluation_parts(content: Mapping[str, Any], everything: bool) -> Iterator[Part]:
    """Return the summary of an evaluation's document, with `everything` its one table besides."""
    names = list(content["estimators"])
    if "scenarios" in content:
        drives, title = content["scenarios"], "Test drives: RMSE in deg"
        yield ranking_table(content["ranking"])
        yield f"Pictures: fleet-slip report {shlex.quote(content['ranking']['estimator'])}"
    elif "cohort" in content:
        drives, title = content["drives"], "RMSE in deg by drive"
        yield from _measured(content)
    else:
        drives, title = content["drives"], "Blind drives: RMSE in deg against the exact angle"
        errors = {name: one["rmse_deg"] for name, one in drives[0]["results"].items()}
        names.sort(key=lambda name: ("@" not in name, errors[name] is None, errors[name]))
        if not everything:
            groups = [one for one in drives if one["drives"] > 1]
            shown = [name for name in names if "/" not in name]
            yield error_table(title, groups, shown[:BLIND_NAMES])
    if everything:
        yield error_table(f"\n{title}", drives, names)
    else:
        yield "Every drive, and all estimators: --all; for machines --json."


def error_table(title: str, drives: Sequence[Mapping[str, Any]], names: Sequence[str]) -> TextTable:
    """Return RMSE by drive and estimator, and of how much of the drive unless of all."""
    words = [name.replace("_", " ") for name in names]  # which a heading can wrap

    def error(found: Mapping[str, Any]) -> str:
        if found["rmse_deg"] is None:
            return "none"
        covered = found["coverage"]
        return f"{found['rmse_deg']:.3f}" + ("" if covered == 1 else f" ({covered:.0%})")

    rows = (
        [
            one["name"],
            f"{one.get('truth', one)['sideslip_std_deg']:.2f}",
            *(error(one["results"][name]) for name in names),
        ]
        for one in drives
    )
    return TextTable(title, "|".join(["drive", "side-slip std", *words]), rows)


def ranking_table(ranking: Mapping[str, Any]) -> TextTable:
    """Return who wins each test drive."""
    least, ours = ranking["least_coverage"], ranking["estimator"]
    return TextTable(
        f"\n{ours} wins {ranking['won']} of {ranking['drives']} test drives by RMSE, and is within "
        f"{ranking['close_ratio']:g} of the winner on {ranking['close']} others.\nAll compete that "
        f"need no GPS and estimate {least:.0%} of the rows. Drives that differ in GPS alone are "
        f"one. {ours}/3 is model 3 of Table I, trained on what {ours} was trained on.",
        f"scenario|won by|RMSE deg|{ours} deg|ratio",
        (one for one in ranking["standings"] if one["same_as"] is None),
        "{scenario}|{winner}|{winner_rmse_deg:.3f}|{rmse_deg:.3f}|{ratio:.2f}",
        left=2,
    )


def _measured(content: Mapping[str, Any]) -> Iterator[Part]:
    """Return figures on measured drives, the best estimator first."""
    drives = number_of(len(content["drives"]), "drive")
    left_out = "quarters of their time" if content["parts_of"] == "time" else "whole"
    kinds = ", ".join(f"{one['name']} ({len(one['drives'])})" for one in content["kinds"])
    yield TextTable(
        f"{content['cohort']}: {drives}, left out {left_out} in turn, in {content['parts']} parts",
        "estimator|knows|RMSE deg|±|mean|std|correlation|rows|worst|kinds left out",
        (
            {**one, "name": name, "kinds": (one["kinds_left_out"] or {}).get("rmse_deg")}
            for name, one in content["estimators"].items()
        ),
        "{name}|{told}|{rmse_deg:.3f}|{rmse_standard_error_deg:.3f}|{error_mean_deg:+.3f}|"
        "{error_std_deg:.3f}|{correlation:.3f}|{coverage:.0%}|{worst_drive_rmse_deg:.3f}|"
        "{kinds:.3f}",
        left=2,
    )
    yield (
        "±: standard error over drives; worst: RMSE of the drive that is estimated worst.\n"
        + (f"Kinds of driving: {kinds}." if kinds else "All drives are of one kind of driving.")
    )
    if content["vehicle"] is None:
        yield (
            "No filter was evaluated: the car is unknown. Give --mass, --front-axle and "
            "--rear-axle, or a vehicle file with --vehicle."
        )


@command(Fleet.score, arguments=["model"])
def score() -> None:
    """Evaluate a model on the rows of a cohort: also the largest error and percentiles.

    Example: **fleet-slip score waterford --cohort "speed_factor > 0.9"**
    """


@command(
    Fleet.evaluate_measured,
    Fleet.evaluate,
    arguments=["model"],
    without=["cohort"],
    others="--fleet",
    scenarios="--scenario",
)
def evaluate(
    fleet: Fleet,
    model: str | None,
    others: list[str],
    scenarios: list[str],
    vehicle: str | None,
    threads: int | None,
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
    everything: Annotated[
        bool, typer.Option("--all", help="Print the errors of all estimators on every drive.")
    ] = False,
    json: Json = False,
    **measured: float | None,
) -> None:
    """Evaluate models on the paper's test drives and on others; simulates those that are missing.

    Beside the model, those of Table I are evaluated, trained on its cohort.

    Prints who wins each test drive. The results are kept as a JSON document below evaluations/ in
    the data root; --json prints it.

    Example: **fleet-slip evaluate waterford --scenario nominal**
    """
    car = vehicle or any(measured.values())
    if (cohort is None and car) or (cohort is not None and (scenarios or blind)):
        raise UsageError(
            "--cohort judges measured drives, for filters in the car of --vehicle or --mass: leave "
            "out --scenario and --blind, and name a cohort."
        )
    if blind and scenarios:
        raise UsageError("--blind has drives of its own: leave out --scenario.")
    if blind:
        content = fleet.evaluate_blind(model, others, threads=threads)
        return print_json(content) if json else print_parts(evaluation_parts(content, everything))
    if cohort is not None:
        kept = fleet.evaluate_measured(
            model, cohort, others, vehicle=vehicle, threads=threads, **measured
        )
    else:
        with progress("simulate scenarios", "rows") as show:
            kept = fleet.evaluate(
                model, others, scenarios=scenarios, threads=threads, progress=show
            )
    if json:
        return print_json({"number": kept.number, "sha256": kept.sha256, **kept.content})
    print_parts(evaluation_parts(kept.content, everything))
    say(f"kept as evaluations/{'' if cohort is None else 'measured/'}{kept.number}.json")


# The command that identifies a car from labelled drives: identify.


@command(Fleet.cohort, FleetCohort.identify, arguments=["name"], without=["unexamined"])
def identify(
    found: "Identified",
    output: Annotated[
        Path | None, typer.Option(help="Write the vehicle file here.", show_default=False)
    ] = None,
    campaign: Annotated[
        Path | None,
        typer.Option(
            help="Write a campaign in the car here, for publish --prior.", show_default=False
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Identify a car's tyres and inertia from labelled drives, as a vehicle file for filters.

    Given what scales and a tape measure say (mass and axles at least), an extended Kalman filter in
    the car is fitted to the label. Its error on drives that were left out stands beside it. A
    steering wheel suffices where no angle of the road wheels is logged.

    Example: **fleet-slip identify hatchback --mass 1776 --front-axle 1.19 --rear-axle 1.44**
    """
    print_answer(found, json)
    train = f". Train with it: fleet-slip publish NAME --prior {campaign}"
    for file, text, then in (
        (output, found.as_toml(), ": a vehicle file, as in configs/vehicles."),
        (campaign, found.as_campaign(), train),
    ):
        if file is not None:
            with storage_errors(file):
                file.write_text(text, encoding="utf-8")
            if not json:
                say(f"written to {file}{then}")


# Commands that show: report, watch, explore.


@command(Fleet.report, arguments=["model"])
def report(written: "Written") -> None:
    """Write one page that lays our figures beside the paper's, from the latest evaluation.

    The page needs nothing but itself; the same figures stand beside it as SVG and PNG files.

    Example: **fleet-slip report waterford**
    """
    say(
        f"{written.page}: {written.size_bytes / 1e6:.1f} MB, {written.figures} figures, "
        f"which are in {written.figures_folder} too"
    )


@command(Fleet.watch, arguments=["what", "model"], without=["json"])
def watch(file: Path) -> None:
    """Show a drive: the car on its track, its true and its estimated angle, wheels and gates.

    The page is one file and needs no server.

    Example: **fleet-slip watch adhesion_0_4 --output slippery.html**
    """
    from fleet_slip.pages.page import size  # noqa: PLC0415 - of the extra, which is there now

    say(f"{file}: {size(file.stat().st_size)}")


@command(without=["json"])
def explore(
    fleet: Fleet,
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
    fleet.warehouse.require()
    words = ["edit" if edit else "run", str(folder("jobs") / "explore.py")]
    words += [*(["--port", str(port)] if port else []), *(["--headless"] if headless else [])]
    command = [sys.executable, "-m", "marimo", *words, "--", "--root", str(fleet.root)]
    os.execv(command[0], command)  # noqa: S606 - the notebook takes the place of this process


SOUND = ("unexamined",)
"""Not an option of what trains no model."""


@command(Fleet.cohort, FleetCohort.diagnose, arguments=["model"], without=SOUND, echo=["condition"])
def diagnose() -> None:
    """Fit a model's signals to a cohort and examine the fit, from Gram rows.

    Standard errors by drives, or by cars where there are several, are the ones to believe: at
    100 Hz a row says little that the one before did not say, and a car's drives share its biases.

    Example: **fleet-slip diagnose waterford**
    """


@command(
    Fleet.cohort,
    FleetCohort.what_if,
    arguments=["model"],
    without=SOUND,
    echo=["condition", "noise", "bias"],
)
def what_if() -> None:
    """Predict a model's error with worse sensors, in closed form; nothing is simulated.

    Bias and noise come on top of what the logs have. Shown too: the best model for such sensors.

    Example: **fleet-slip what-if waterford --noise ay=0.2 --bias yaw_rate=0.02**
    """
