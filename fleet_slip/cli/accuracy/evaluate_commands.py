"""Commands that evaluate: score on the rows of a cohort, evaluate on test drives."""

from typing import Annotated

import typer

from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.cli.accuracy.evaluation_tables import print_evaluation, print_summary
from fleet_slip.cli.accuracy.judgement_tables import print_blind, print_own_car
from fleet_slip.cli.completing import complete_config
from fleet_slip.cli.left_out import say_examined, say_without_information
from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.models.diff_command import score_against
from fleet_slip.cli.options import Unexamined
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.record_runs import record_run
from fleet_slip.cli.workers import Threads
from fleet_slip.errors import UsageError
from fleet_slip.models.estimates.score import Score, score_statement
from fleet_slip.words import number_of

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
