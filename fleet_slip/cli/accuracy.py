"""Commands that evaluate: score on the rows of a cohort, evaluate on test drives."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.base import require_extra
from fleet_slip.cli.options import command
from fleet_slip.cli.output import Json, print_answer, say
from fleet_slip.cli.progress import progress
from fleet_slip.errors import UsageError
from fleet_slip.resources import folder
from fleet_slip.storage.storage_errors import storage_errors

if TYPE_CHECKING:
    from fleet_slip.evaluation.identify import IdentifiedVehicle
    from fleet_slip.evaluation.report import WrittenReport


@command(Fleet.score, arguments=["model"])
def score() -> None:
    """Evaluate a model on the rows of a cohort: also the largest error and percentiles.

    Example: fleet-slip score waterford --cohort "speed_factor > 0.9"
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
            help="Evaluate on measured drives with a label instead: SQL predicate on the view "
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

    Example: fleet-slip evaluate waterford --scenario nominal
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
        found = fleet.evaluate_blind(model, others, threads=threads)
    elif cohort is not None:
        found = fleet.evaluate_measured(
            model, cohort, others, vehicle=vehicle, threads=threads, **measured
        )
    else:
        with progress("simulate scenarios") as show:
            found = fleet.evaluate(
                model, others, scenarios=scenarios, threads=threads, progress=show
            )
    print_answer(found, json, everything=everything)


# The command that identifies a car from labelled drives: identify.


@command(Fleet.cohort, FleetCohort.identify, arguments=["name"], without=["include_faulty"])
def identify(
    found: "IdentifiedVehicle",
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

    Example: fleet-slip identify hatchback --mass 1776 --front-axle 1.19 --rear-axle 1.44
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
def report(written: "WrittenReport") -> None:
    """Write a page that compares the latest evaluation with the paper's figures.

    The page needs nothing but itself; the same figures stand beside it as SVG and PNG files.

    Example: fleet-slip report waterford
    """
    say(
        f"{written.page}: {written.size_bytes / 1e6:.1f} MB, {written.figures} figures, "
        f"which are in {written.figures_folder} too"
    )


@command(Fleet.watch, arguments=["what", "model"], without=["json"])
def watch(file: Path) -> None:
    """Show a drive: the car on its track, its true and its estimated angle, wheels and gates.

    The page is one file and needs no server.

    Example: fleet-slip watch adhesion_0_4 --output slippery.html
    """
    say(f"{file}: {file.stat().st_size / 1e6:.1f} MB")


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

    Example: fleet-slip explore --headless
    """
    with require_extra("explore", "the notebook"):
        import altair  # noqa: F401, PLC0415 - an extra
        import marimo  # noqa: F401, PLC0415
        import numba  # noqa: F401, PLC0415
    fleet.warehouse.require()
    words = ["edit" if edit else "run", str(folder("jobs") / "explore.py")]
    words += [*(["--port", str(port)] if port else []), *(["--headless"] if headless else [])]
    opened = ["--root", str(fleet.root)]
    if config := fleet.warehouse.configs.folder:
        opened += ["--config", str(config)]
    command = [sys.executable, "-m", "marimo", *words, "--", *opened]
    os.execv(command[0], command)  # noqa: S606 - the notebook takes the place of this process


SCREEN = ("include_faulty",)
"""Not an option of what trains no model."""


@command(
    Fleet.cohort, FleetCohort.diagnose, arguments=["model"], without=SCREEN, echo=["predicate"]
)
def diagnose() -> None:
    """Fit a model's signals to a cohort and examine the fit, from Gram rows.

    Standard errors by drives, or by cars where there are several, are the ones to believe: at
    100 Hz a row says little that the one before did not say, and a car's drives share its biases.

    Example: fleet-slip diagnose waterford
    """
