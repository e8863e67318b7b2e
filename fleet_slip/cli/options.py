"""Options and arguments that several commands share, and what runs a command."""

import functools
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import TYPE_CHECKING, Annotated, Literal, ParamSpec, cast

from typer import Argument, Context, Option

import fleet_slip
from fleet_slip.errors import FleetSlipError
from fleet_slip.storage.runs import recording

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet

P = ParamSpec("P")


def fleet_of(context: Context) -> "Fleet":
    """Return the fleet that --root and --config name."""
    fleet: Fleet = context.obj()
    return fleet


def recorded(command: Callable[P, None]) -> Callable[P, None]:
    """Record each run of a command in the view `runs`, but for dry runs."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        if options.get("dry_run"):
            return command(*arguments, **options)
        context = cast(Context, options["context"])
        warehouse = fleet_of(context).warehouse
        lineage: AbstractContextManager[None] = nullcontext()
        with recording(warehouse.root, command.__name__, sys.argv[1:]) as current_run:
            if target := context.find_root().params.get("lineage"):
                from fleet_slip.operations.lineage import emit_lineage

                lineage = emit_lineage(target, warehouse, current_run, options)
            with lineage:
                return command(*arguments, **options)

    return run


def complete_model(context: Context, incomplete: str) -> list[str]:
    """Return names of models for the completion of a shell, and versions of a complete name."""
    options = context.parent.params if context.parent else {}
    name, at, _ = incomplete.partition("@")
    with suppress(FleetSlipError):
        registry = fleet_slip.open(options.get("root"), options.get("config")).models.registry
        references = registry.names()
        if at:
            versions = [*map(str, registry.versions(name)), *registry.history(name).aliases()]
            references = [f"{name}@{version}" for version in versions]
        return [reference for reference in references if reference.startswith(incomplete)]
    return []


Json = Annotated[bool, Option("--json", help="Print machine-readable JSON on stdout.")]
All = Annotated[bool, Option("--all", help="Print all rows and columns.")]

Threads = Annotated[
    int | None, Option(min=1, help="Threads on this machine. Default: one per core.")
]
Cluster = Annotated[
    str | None,
    Option(
        envvar="DASK_SCHEDULER_ADDRESS",
        metavar="ADDRESS",
        help="Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers share the "
        "data root. Default: threads on this machine.",
    ),
]

Model = Annotated[
    str | None,
    Argument(
        metavar="MODEL",
        autocompletion=complete_model,
        help="NAME, NAME@VERSION or NAME@ALIAS. Default: the only published model.",
    ),
]
ModelName = Annotated[str, Argument(help="Name of the model.", autocompletion=complete_model)]
Alias = Annotated[str, Option(help="Alias.")]
Version = Annotated[
    str,
    Argument(
        help="NAME (its champion), NAME@VERSION or NAME@ALIAS.", autocompletion=complete_model
    ),
]
Candidate = Annotated[
    bool, Option("--candidate", help="Publish as a candidate; promote makes it champion.")
]

Cohort = Annotated[str, Option(help="SQL predicate on the view drives.")]
IncludeFaulty = Annotated[
    bool, Option("--include-faulty", help="Include drives with faulty sensors.")
]
Mapping = Annotated[str, Option(help="Mapping of configs/mappings, or a TOML file.")]
CampaignDays = Annotated[
    int | None, Option(min=1, help="Simulate only the first N days. Default: all.")
]
Through = Annotated[
    str | None, Option(help="Last day to simulate, YYYY-MM-DD or today. Default: all days.")
]
Retention = Annotated[
    str | None, Option(help="Retention file. Default: retention.toml of the configs.")
]
Vehicle = Annotated[
    str | None,
    Option(
        help="Car of the filters: a vehicle of configs/vehicles, or a TOML file with mass_kg, "
        "front_axle_m and rear_axle_m."
    ),
]

# How models are selected.

ModelList = Annotated[
    str | None,
    Option(
        help="Model list of configs/models, or a TOML file. Default: estimator, or table1 with "
        "--features or without the Gram rows of estimator."
    ),
]
OneModel = Annotated[
    str | None, Option(help='Inputs of one model instead of a list, such as "ax, ay, yaw_rate".')
]
Order = Annotated[
    str | None,
    Option(
        help="Inputs, separated by commas, whose first 1, 2, ... form nested models; 'catalogue' "
        "is all inputs, a family of windows or gates its columns."
    ),
]
Features = Annotated[
    str | None,
    Option(help="Feature set of configs/features.toml. Default: the list's, or signals."),
]
Label = Annotated[
    Literal["course"] | None,
    Option(
        help="Train without a reference sensor, on changes of the course over ground. The default "
        "feature set and model list are then those called course."
    ),
]
FoldKey = Literal["drive", "vehicle", "track", "day", "mass", "adhesion", "speed", "part"]
GroupBy = Annotated[
    FoldKey | None, Option("--group-by", help="Groups that form the folds. Default: the list's.")
]
Folds = Annotated[
    str | None,
    Option(
        metavar="NUMBER|each",
        help="Number of folds, or each for one fold per group. Default: the list's.",
    ),
]
Ranking = Annotated[
    str | None, Option(help="Ranking of inputs: declared (default), forward or backward.")
]
Criterion = Annotated[
    str | None,
    Option(
        help="Criterion for the number of ranked inputs: cv (the smallest model within --tolerance "
        "of the best), aic or bic. Default: cv."
    ),
]
Tolerance = Annotated[
    str | None,
    Option(
        help="Smallest gain that justifies another signal, such as 0.025deg: the root of the "
        "difference of the mean squared errors. Models within it, or within one standard error of "
        "the difference, count as equal. Default: 0.025deg, or the list's."
    ),
]
Robust = Annotated[
    bool, Option("--robust", help="Down-weight drives with an error above three times the median.")
]
Intercept = Annotated[
    bool, Option("--intercept/--no-intercept", help="Fit an intercept, or go through the origin.")
]
Search = Annotated[
    str | None,
    Option(help="Search among the inputs, repeated in every fold: forward, backward or exchange."),
]
MaxFeatures = Annotated[
    int | None, Option(min=1, max=200, help="Maximum number of columns of --search. Default: 24.")
]
HalfLife = Annotated[
    int | None, Option(help="Days before the newest after which a drive counts half as much.")
]
Prior = Annotated[
    str | None,
    Option(
        help="Campaign of configs/campaigns, or a TOML file, whose simulated drives join the "
        "training with an eighth of the weight of all real rows, unless held-out drives have a "
        "clearly larger error with them. See: fleet-slip identify --campaign."
    ),
]
