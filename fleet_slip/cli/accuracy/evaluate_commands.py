"""Commands that evaluate: score on the rows of a cohort, evaluate on test drives."""

from typing import Annotated

import typer

from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.cli.accuracy.evaluation_tables import print_blind, print_evaluation, print_summary
from fleet_slip.cli.begin.run_command import DEFAULT_CAMPAIGN
from fleet_slip.cli.completing import complete_config, complete_model
from fleet_slip.cli.models.diff_command import score_against
from fleet_slip.cli.models.version_commands import Reference
from fleet_slip.cli.options import Cohort
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.workers import Threads
from fleet_slip.errors import UsageError
from fleet_slip.models.score import score_statement
from fleet_slip.words import number_of

OneCar = Annotated[
    str,
    typer.Option(
        help="NAME, NAME@VERSION or NAME@ALIAS of a model. It is evaluated, and the models of "
        "Table I on the cohort that it was trained on.",
        autocompletion=complete_model,
    ),
]
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
    reference: Reference,
    cohort: Cohort = ALL_DRIVES,
    sql: Annotated[bool, typer.Option("--sql", help="Print the statement and do nothing.")] = False,
    against: Annotated[
        str | None,
        typer.Option(help="Another version of the model, such as champion, on the same rows."),
    ] = None,
    json: Json = False,
) -> None:
    """Evaluate a model on the rows of a cohort: also the largest error and percentiles.

    Example: **fleet-slip score waterford --cohort "speed_factor > 0.9"**
    """
    version = context.obj.model(reference)
    if sql:
        typer.echo(score_statement(version.manifest, cohort))
        return
    if against is not None:
        name = against if "@" in against else f"{version.manifest.name}@{against}"
        other = context.obj.model(name)
        score_against(context.obj.warehouse, version, other, cohort, json)
        return
    result = context.obj.score(version, cohort).as_dict()
    if json:
        print_json({"model": version.reference, "cohort": cohort, **result})
        return
    print_table(
        f"{version.reference} on {number_of(result['rows'], 'row')}",
        ["figure", "value"],
        [
            [name.replace("_deg", ", deg").replace("_", " "), f"{value:.4f}"]
            for name, value in result.items()
            if name != "rows" and value is not None
        ],
    )


@record_run
def evaluate(
    context: typer.Context,
    one_car: OneCar = DEFAULT_CAMPAIGN,
    fleet: FleetModels = None,
    scenario: Scenarios = None,
    rivals: Annotated[
        bool,
        typer.Option(
            "--rivals",
            help="Also train networks, trees and neuro-fuzzy rules, on the model's columns too. "
            "Takes minutes, and needs scikit-learn.",
        ),
    ] = False,
    blind: Annotated[
        bool,
        typer.Option(
            "--blind",
            help="Judge on roads, cars, weather and drivers that are drawn from the hash of the "
            "model's version, which nobody can have seen before it was published.",
        ),
    ] = False,
    threads: Threads = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all estimators, sections and requirements.")
    ] = False,
    json: Json = False,
) -> None:
    """Evaluate models on the paper's test drives and on others; simulates those that are missing.

    Prints who wins each test drive; all of it with --all. The results are kept as a JSON document
    below evaluations/ in the data root.

    Example: **fleet-slip evaluate --one-car waterford --scenario nominal**
    """
    if blind:
        if scenario:
            raise UsageError("--blind has drives of its own: leave out --scenario.")
        rows = context.obj.evaluate_blind(one_car, fleet or (), rivals=rivals, threads=threads)
        if json:
            print_json({"blind": [row.as_dict() for row in rows]})
        else:
            print_blind(rows, everything)
        return
    with progress("simulate scenarios", "rows") as show:
        kept = context.obj.evaluate(
            one_car,
            fleet or (),
            scenarios=scenario or (),
            rivals=rivals,
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
            print_summary(content, one_car)
        say(f"kept as evaluations/{kept.number}.json")
