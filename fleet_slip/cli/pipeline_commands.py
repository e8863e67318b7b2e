"""Commands that run several steps: demo, run, learn, nightly."""

import os
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Context, Option

from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.cli import options as opt
from fleet_slip.cli.data_commands import warn_of_passed_over
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import print_answer, print_json, print_parts, progress_of_steps, say
from fleet_slip.errors import UsageError

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet


def demo(
    context: Context,
    output: Annotated[Path, Option(help="Folder to write into: data, c and report.html.")] = Path(
        "fleet-slip-demo"
    ),
    open_page: Annotated[bool, Option("--open", help="Open the report in the browser.")] = False,
) -> None:
    """Simulate 12 drives, train a model, export it as C, and show it on another drive.

    It takes half a minute, and less when it is repeated. The data root is the folder data of
    --output.

    Example: fleet-slip demo --output /tmp/demo
    """
    import fleet_slip

    if context.parent and context.parent.params["root"]:
        raise UsageError("demo has a data root of its own: leave out --root, and give --output.")
    start = time.monotonic()
    with fleet_slip.open(output / "data") as fleet:
        with progress_of_steps() as show:
            report = fleet.run("demo", progress=show)
            show("export and report", 0, None)
            model = fleet.models.get("demo")
            sources = fleet.models.export(model, "c", output / "c")
            page = fleet.evaluation.watch("nominal", model, output / "report.html", until_s=60.0)
        validation = model.manifest.cross_validation
    c_file = next(file for file in sources if file.suffix == ".c")
    print_parts(
        [
            f"logs    12 simulated drives in {output / 'data'}",
            f"model   {model.reference}: {len(model.manifest.terms)} inputs, held-out RMSE "
            f"{validation.rmse_deg:.3f} deg",
            f"in C    {c_file}, integer arithmetic",
            f"report  {page}: a drive outside the training set, with its true and estimated angle",
        ]
    )
    if not report.changed:
        say("nothing to do: the demo was run before.")
    say(f"done in {time.monotonic() - start:.0f} s")
    _say_next(
        fleet,
        "show demo",
        'sql "SELECT drive_id, rows, speed_factor FROM drives"',
        "evaluate demo",
        "report demo",
    )
    if open_page:
        typer.launch(str(page))


def run(
    context: Context,
    campaign: Annotated[
        str, Option(help="Campaign of configs/campaigns, or a TOML file.")
    ] = "waterford",
    days: opt.CampaignDays = None,
    through: opt.Through = None,
    name: Annotated[str | None, Option(help="Name of the model. Default: the campaign's.")] = None,
    models: opt.ModelList = None,
    threads: opt.Threads = None,
    cluster: opt.Cluster = None,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """Simulate a campaign, update Gram rows, select a model, publish it if it is not worse.

    It can be repeated at any time, also after an interruption: completed work is not repeated. A
    second run of the campaign at the same time waits for the first. A nightly run appends the next
    day with --through today.

    Example: fleet-slip run --campaign smoke
    """
    fleet = fleet_of(context)
    with progress_of_steps() as show:
        report = fleet.run(
            campaign,
            days=days,
            through=through,
            name=name,
            models=models,
            workers=cluster or threads,
            progress=show,
        )
    print_answer(report, json, everything=everything)
    if json or not (report.publication and report.publication.new):
        return
    version = report.publication.version
    if version.version == 1:
        _say_next(
            fleet,
            'sql "SELECT drive_id, rows, speed_factor FROM drives"',
            f"show {version.manifest.name}",
            'select --cohort "adhesion > 0.8"',
            f"evaluate {version.manifest.name}",
            f"report {version.manifest.name}",
        )


def learn(
    context: Context,
    name: opt.ModelName,
    logs: Annotated[
        list[str],
        Argument(help="Log files or folders; earlier files are skipped."),
    ],
    mapping: opt.Mapping,
    threads: opt.Threads = None,
    cluster: opt.Cluster = None,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """Train a model on measured logs: ingest, gram, select, publish. Repeat it for new logs.

    The label is the side-slip angle of the mapping, else the course over ground. The command ends
    with its assumptions and the next commands. Draft the mapping with: fleet-slip mapping suggest

    Example: fleet-slip learn golf logs/ --mapping golf.toml
    """
    fleet = fleet_of(context)
    warn_of_passed_over(logs)
    with progress_of_steps() as show:
        report = fleet.learn(name, logs, mapping, workers=cluster or threads, progress=show)
    if json:
        print_json(report)
    else:
        print_parts(report.parts(everything))
        if report.changed and report.publication:
            steps = [f"show {name}", f"export {name} --to c --output {name}"]
            if not report.publication.version.manifest.learned_from:
                steps.append(f"evaluate {name} --cohort \"campaign = '{report.mapping}'\"")
            _say_next(fleet, *steps)
    if report.problem:
        raise report.problem


def nightly(
    context: Context,
    inbox: Annotated[str, Option(help="Folder of logs; new logs in it are ingested.")],
    mapping: opt.Mapping,
    model: Annotated[str, Option(help="Name of the model.")],
    cohort: opt.Cohort = TRAINING_DRIVES,
    models: opt.ModelList = None,
    candidate: opt.Candidate = False,
    retention: opt.Retention = None,
    night: Annotated[
        str | None, Option(help="Date of the night, YYYY-MM-DD. Default: today.")
    ] = None,
    threads: opt.Threads = None,
    cluster: opt.Cluster = None,
    output: Annotated[
        Path | None,
        Option(
            help="Folder for the summary: NIGHT.txt and NIGHT.json. The files name drives; forget "
            "does not change them."
        ),
    ] = None,
    json: opt.Json = False,
) -> None:
    """Run the nightly job: ingest new logs, check their sensors, train again, verify.

    Drives with faulty sensors train no model. The winner becomes champion if it is not worse, else
    a candidate. A night that was killed and is repeated ends where it would have ended. Exit code
    10 if something needs attention, else the code of the first step that failed.

    Example: fleet-slip nightly --inbox /srv/logs --mapping logger.toml --model fleet
    """
    with progress_of_steps() as show:
        report = fleet_of(context).nightly(
            inbox,
            mapping,
            model,
            cohort=cohort,
            models=models,
            candidate=candidate,
            retention=retention,
            night=night,
            workers=cluster or threads,
            progress=show,
        )
    if output is not None:
        from fleet_slip.operations.night import write_summary

        write_summary(report, output)
    print_answer(report, json)


def _say_next(fleet: "Fleet", *steps: str) -> None:
    """Print commands to continue with, as they can be typed."""
    started = Path(sys.argv[0])
    on_path = shutil.which(started.name)
    is_on_path = on_path and os.path.realpath(on_path) == os.path.realpath(started)
    program = started.name if is_on_path else shlex.quote(str(started.absolute()))
    say("next:")
    for line in steps:
        say(f"  {program} --root {shlex.quote(str(fleet.root))} {line}")
