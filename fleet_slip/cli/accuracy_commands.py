"""Commands that evaluate models and show drives: score, evaluate, identify, report, watch."""

import os
import sys
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Option

from fleet_slip.base import require_extra
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import print_answer, progress, say, write_text
from fleet_slip.errors import UsageError


def score(
    context: Context,
    model: opt.Model = None,
    cohort: Annotated[
        str | None,
        Option(help="SQL predicate on the view drives. Default: drives outside the training."),
    ] = None,
    include_faulty: opt.IncludeFaulty = False,
    json: opt.Json = False,
) -> None:
    """Evaluate a model on the rows of a cohort: RMSE, largest error and percentiles.

    Default: all drives that the model was not trained on, or all if there are no others.

    Example: fleet-slip score waterford --cohort "speed_factor > 0.9"
    """
    result = fleet_of(context).evaluation.score(model, cohort, include_faulty=include_faulty)
    print_answer(result, json)


def predict(
    context: Context,
    model: opt.Version,
    logs: Annotated[list[Path], Argument(metavar="LOG...", help="Log files or folders.")],
    mapping: opt.Mapping,
    output: Annotated[Path, Option(help="File to write: .parquet, .csv or .mf4.")],
    replace: Annotated[bool, Option("--replace", help="Replace the file if it exists.")] = False,
    json: opt.Json = False,
) -> None:
    """Predict the side-slip angle of log files, beside the reference where they have one.

    Writes drive_id, time_s since the drive began, sideslip_estimate_deg and
    sideslip_reference_deg. Nothing is ingested.

    Example: fleet-slip predict waterford drive.csv --mapping logger.toml --output beta.parquet
    """
    predictions = fleet_of(context).models.predict(model, logs, mapping, output, replace=replace)
    print_answer(predictions, json)


def evaluate(
    context: Context,
    model: opt.Model = None,
    compare: Annotated[
        list[str] | None, Option(help="Another model to evaluate beside it. May be repeated.")
    ] = None,
    scenario: Annotated[
        list[str] | None,
        Option(
            help="Scenario of configs/scenarios, or a TOML file. May be repeated. Default: all."
        ),
    ] = None,
    blind: Annotated[
        bool,
        Option(
            "--blind",
            help="Evaluate on random roads, cars, weather and drivers, drawn from the hash of the "
            "version: unknown before it was published.",
        ),
    ] = False,
    cohort: Annotated[
        str | None,
        Option(help="SQL predicate on the view drives: evaluate on these measured drives instead."),
    ] = None,
    include_faulty: opt.IncludeFaulty = False,
    vehicle: opt.Vehicle = None,
    threads: opt.Threads = None,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """Evaluate models on the paper's test drives and on others; simulate those that are missing.

    The models of Table I, trained on the cohort of the model, are evaluated beside it. Prints the
    best estimator of each test drive. The results are stored as a JSON document in evaluations/ of
    the data root; --json prints it. --scenario is a scenario of configs/scenarios, or a TOML file.

    With --cohort the drives are measured ones with a label. Models and filters are trained without
    the drives, or parts, that they are evaluated on. With --blind roads, cars, weather and drivers
    were unknown before the version was published.

    Example: fleet-slip evaluate waterford --scenario nominal
    """
    if (cohort is None and vehicle) or (cohort is not None and (scenario or blind)):
        raise UsageError(
            "--cohort evaluates on measured drives, with filters in the car of --vehicle: leave "
            "out --scenario and --blind, and name a cohort."
        )
    if blind and scenario:
        raise UsageError("--blind has drives of its own: leave out --scenario.")
    evaluation = fleet_of(context).evaluation
    challengers = compare or ()
    if blind:
        result = evaluation.evaluate_blind(model, challengers, threads=threads)
    elif cohort is not None:
        result = evaluation.evaluate_measured(
            model,
            cohort,
            challengers,
            vehicle=vehicle,
            include_faulty=include_faulty,
            threads=threads,
        )
    else:
        with progress("simulate scenarios") as show:
            result = evaluation.evaluate(
                model, challengers, scenarios=scenario or (), threads=threads, progress=show
            )
    print_answer(result, json, everything=everything)


def identify(
    context: Context,
    name: Annotated[str, Argument(help="Name of the car.")],
    vehicle: Annotated[
        str,
        Option(
            help="Measured data of the car: a TOML file with mass_kg, front_axle_m and rear_axle_m."
        ),
    ],
    cohort: opt.Cohort = TRAINING_DRIVES,
    threads: opt.Threads = None,
    output: Annotated[
        Path | None, Option(help="Vehicle file to write, for --vehicle and --with-filter.")
    ] = None,
    campaign: Annotated[
        Path | None, Option(help="Campaign file with the car to write, for publish --prior.")
    ] = None,
    json: opt.Json = False,
) -> None:
    """Identify a car's tyres and inertia from labelled drives, as a vehicle file for filters.

    An extended Kalman filter in the car is fitted to the label. --vehicle has mass_kg, front_axle_m
    and rear_axle_m, optionally track_m, height_m, rolling_radius_m and front_drive_share. The
    result contains its error on drives that were left out. A logged steering wheel angle suffices
    where no road wheel angle is logged.

    Example: fleet-slip identify hatchback --vehicle measures.toml --output hatchback.toml
    """
    car = fleet_of(context).evaluation.identify(
        name,
        vehicle,
        cohort,
        threads=threads,
    )
    print_answer(car, json)
    train = f". Train with it: fleet-slip publish NAME --prior {campaign}"
    for file, text, remark in (
        (output, car.as_toml(), ": a vehicle file, as in configs/vehicles."),
        (campaign, car.as_campaign(), train),
    ):
        if file is not None:
            write_text(file, text, "" if json else remark)


def report(
    context: Context,
    model: opt.Model = None,
    output: Annotated[
        Path | None, Option(help="Folder to write into. Default: report/ in the data root.")
    ] = None,
    json: opt.Json = False,
) -> None:
    """Write a page that compares the latest evaluation with the paper's figures.

    The page is self-contained; its figures are also written as SVG and PNG files.

    Example: fleet-slip report waterford
    """
    from fleet_slip.cli.output import print_json

    result = fleet_of(context).evaluation.report(model, output)
    if json:
        print_json(result)
        return
    say(
        f"{result.page}: {result.size_bytes / 1e6:.1f} MB, {result.figures} figures, "
        f"which are in {result.figures_folder} too"
    )


def watch(
    context: Context,
    drive: Annotated[
        str,
        Argument(
            metavar="SCENARIO|DRIVE",
            help="A scenario, or a logged drive by its drive_id, name or file.",
        ),
    ],
    model: opt.Model = None,
    output: Annotated[Path, Option(help="Page to write, .html. It plays in a browser.")] = Path(
        "watch.html"
    ),
    from_s: Annotated[float, Option("--from", help="First second of the drive.")] = 0.0,
    until_s: Annotated[
        float | None, Option("--until", help="Last second. Default: the end.")
    ] = None,
) -> None:
    """Show a drive: the car on its track, its angle and the estimate, wheels and gates.

    It is a scenario of configs/scenarios, a TOML file, or a logged drive: its drive_id, its name,
    or the name of its file. The page is one file and needs no server.

    Example: fleet-slip watch adhesion_0_4 --output slippery.html
    """
    file = fleet_of(context).evaluation.watch(drive, model, output, from_s=from_s, until_s=until_s)
    say(f"{file}: {file.stat().st_size / 1e6:.1f} MB")


def explore(
    context: Context,
    edit: Annotated[bool, Option("--edit", help="Show the code, for editing.")] = False,
    port: Annotated[int | None, Option(min=1, max=65535, help="Port on this machine.")] = None,
    headless: Annotated[
        bool, Option("--headless", help="Print the address, and open no browser.")
    ] = False,
) -> None:
    """Explore a data root in the browser: cohorts by mouse, error maps, coefficients, drift.

    Starts a marimo notebook, which runs until it is interrupted.

    Example: fleet-slip explore --headless
    """
    with require_extra("explore", "the notebook"):
        import altair  # noqa: F401 - an extra
        import marimo  # noqa: F401
        import numba  # noqa: F401
    from fleet_slip.resources import folder

    fleet = fleet_of(context)
    fleet.warehouse.require()
    words = ["edit" if edit else "run", str(folder("jobs") / "explore.py")]
    words += [*(["--port", str(port)] if port else []), *(["--headless"] if headless else [])]
    options = ["--root", str(fleet.root)]
    if config := fleet.warehouse.configs.folder:
        options += ["--config", str(config)]
    command = [sys.executable, "-m", "marimo", *words, "--", *options]
    os.execv(command[0], command)  # noqa: S606 - the notebook replaces this process
