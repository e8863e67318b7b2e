"""Options and arguments that several commands share, and what runs a command."""

import functools
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import TYPE_CHECKING, Annotated, Literal, ParamSpec, cast

import typer

import fleet_slip
from fleet_slip.errors import FleetSlipError
from fleet_slip.storage.runs import Run, recording

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.models.registry import Registry
    from fleet_slip.warehouse.warehouse import Warehouse

P = ParamSpec("P")


def fleet_of(context: typer.Context) -> "Fleet":
    """Return the fleet that --root and --config name."""
    fleet: Fleet = context.obj()
    return fleet


def recorded(command: Callable[P, None]) -> Callable[P, None]:
    """Record each run of a command in the view `runs`, but for dry runs."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        if options.get("dry_run"):
            return command(*arguments, **options)
        context = cast(typer.Context, options["context"])
        warehouse = fleet_of(context).warehouse
        with (
            recording(warehouse.root, command.__name__, sys.argv[1:]) as current_run,
            _lineage(context, warehouse, current_run, options),
        ):
            return command(*arguments, **options)

    return run


def _lineage(
    context: typer.Context, warehouse: "Warehouse", current_run: Run, options: dict[str, object]
) -> AbstractContextManager[None]:
    """Return what emits the events of a run, if --lineage names a file or a URL."""
    target = context.find_root().params.get("lineage")
    if not target:
        return nullcontext()
    from fleet_slip.operations.lineage import emit_lineage

    return emit_lineage(target, warehouse, current_run, options)


def complete_name(context: typer.Context, incomplete: str) -> list[str]:
    """Return the names of models for the completion of a shell."""
    with suppress(FleetSlipError):
        names = _registry(context).names()
        return [name for name in names if name.startswith(incomplete)]
    return []


def complete_reference(context: typer.Context, incomplete: str) -> list[str]:
    """Return names of models, or versions and aliases once a name is complete."""
    name, at, _ = incomplete.partition("@")
    if not at:
        return complete_name(context, incomplete)
    with suppress(FleetSlipError):
        registry = _registry(context)
        versions = [*map(str, registry.versions(name)), *registry.history(name).aliases()]
        references = [f"{name}@{version}" for version in versions]
        return [reference for reference in references if reference.startswith(incomplete)]
    return []


def _registry(context: typer.Context) -> "Registry":
    """Return the registry of a command line that is not complete yet."""
    options = context.parent.params if context.parent else {}
    return fleet_slip.open(options.get("root"), options.get("config")).models.registry


Json = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON on stdout.")]
All = Annotated[bool, typer.Option("--all", help="Print all rows and columns.")]

Threads = Annotated[
    int | None, typer.Option(min=1, help="Threads on this machine. Default: one per core.")
]
Cluster = Annotated[
    str | None,
    typer.Option(
        envvar="DASK_SCHEDULER_ADDRESS",
        metavar="ADDRESS",
        help="Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers share the "
        "data root. Default: threads on this machine.",
    ),
]

Model = Annotated[
    str | None,
    typer.Argument(
        metavar="MODEL",
        autocompletion=complete_reference,
        help="NAME, NAME@VERSION or NAME@ALIAS of a published model; NAME alone is its champion. "
        "Default: the only published model.",
    ),
]
ModelName = Annotated[str, typer.Argument(help="Name of the model.", autocompletion=complete_name)]
Alias = Annotated[str, typer.Option(help="Alias.")]
Version = Annotated[
    str,
    typer.Argument(
        help="NAME, NAME@VERSION or NAME@ALIAS; NAME alone is its champion.",
        autocompletion=complete_reference,
    ),
]

Cohort = Annotated[str, typer.Option(help="SQL predicate on the view drives.")]
IncludeFaulty = Annotated[
    bool, typer.Option("--include-faulty", help="Include drives with faulty sensors.")
]
Mapping = Annotated[str, typer.Option(help="Mapping of configs/mappings, or a TOML file.")]
CampaignDays = Annotated[
    int | None, typer.Option(min=1, help="Simulate only the first N days. Default: all.")
]
Through = Annotated[
    str | None, typer.Option(help="Last day to simulate, YYYY-MM-DD or today. Default: all days.")
]

# How models are selected.

ModelList = Annotated[
    str | None,
    typer.Option(
        help="Model list of configs/models, or a TOML file. Default: estimator, or table1 with "
        "--features or without the Gram rows of estimator."
    ),
]
OneModel = Annotated[
    str | None,
    typer.Option(
        help='Inputs of one model, separated by commas, such as "ax, ay, yaw_rate", instead of a '
        "list."
    ),
]
Order = Annotated[
    str | None,
    typer.Option(
        help="Inputs, separated by commas, whose first 1, 2, ... form nested models; 'catalogue' "
        "is all inputs, a family of windows or gates its columns."
    ),
]
Features = Annotated[
    str | None,
    typer.Option(
        help="Feature set of configs/features.toml, computed by: fleet-slip gram --features NAME. "
        "Default: the list's, else the logged signals."
    ),
]
Label = Annotated[
    Literal["course"] | None,
    typer.Option(
        help="Train without a reference sensor, on changes of the course over ground. Default "
        "feature set and model list are then those called course."
    ),
]
FoldKey = Literal["drive", "vehicle", "track", "day", "mass", "adhesion", "speed", "part"]
GroupBy = Annotated[
    FoldKey | None,
    typer.Option("--group-by", help="Groups that form the folds. Default: the list's."),
]
Folds = Annotated[
    str | None,
    typer.Option(
        metavar="NUMBER|each",
        help="Number of folds, or each for one fold per group. Default: the list's.",
    ),
]
Ranking = Annotated[
    str | None,
    typer.Option(
        help="Ranking of the inputs of --order: declared, correlation, t, forward or backward. "
        "Default: declared."
    ),
]
Criterion = Annotated[
    str | None,
    typer.Option(
        help="Criterion for the number of ranked inputs: cv (the smallest model within --tolerance "
        "of the best), cp, aic, aic-likelihood, bic, bic-likelihood, ric or adjusted-r2. Default: "
        "cv."
    ),
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        help="Smallest gain that justifies another signal: an angle such as 0.025deg (root of the "
        "difference of the mean squared errors), or a share of the RMSE such as 2%. Models within "
        "it, or within one standard error of the difference, count as equal. Default: 0.025deg, or "
        "the list's."
    ),
]
AllSubsets = Annotated[
    bool, typer.Option("--all-subsets", help="Search all subsets of the inputs of --order.")
]
Robust = Annotated[
    bool,
    typer.Option(
        "--robust",
        help="Down-weight outlier drives (error above three times the median). Lists them; see "
        "diagnose.",
    ),
]
ClusterUnit = Annotated[
    Literal["drive", "vehicle"] | None,
    typer.Option(
        help="Unit of independent evidence. Default: vehicle if there are several, else drive."
    ),
]
Intercept = Annotated[
    bool,
    typer.Option(
        "--intercept/--no-intercept", help="Fit an intercept, or force models through the origin."
    ),
]
Search = Annotated[
    str | None,
    typer.Option(
        help="Search method among the inputs of --order, or all: forward, backward or exchange. "
        "The search is repeated in every fold."
    ),
]
MaxFeatures = Annotated[
    int | None,
    typer.Option(
        min=1, max=200, help="Maximum number of columns that --search may add. Default: 24."
    ),
]
HalfLife = Annotated[
    int | None,
    typer.Option(
        help="Days, counted back from the cohort's newest day, after which a drive counts half as "
        "much."
    ),
]
Prior = Annotated[
    str | None,
    typer.Option(
        help="Campaign of configs/campaigns, or a TOML file, whose simulated drives join the "
        "training with an eighth of the weight of all real rows, unless held-out drives have a "
        "clearly larger error with them. See: fleet-slip identify --campaign."
    ),
]

# Measured data of a car.

Mass = Annotated[float | None, typer.Option(help="Mass of the car with its driver, kg.")]
FrontAxle = Annotated[
    float | None, typer.Option(help="Distance from centre of gravity to front axle, m.")
]
RearAxle = Annotated[
    float | None, typer.Option(help="Distance from centre of gravity to rear axle, m.")
]
TrackWidth = Annotated[float | None, typer.Option(help="Track width, m. Default: 1.55.")]
Height = Annotated[
    float | None, typer.Option(help="Height of the centre of gravity, m. Default: 0.55.")
]
Radius = Annotated[
    float | None, typer.Option(help="Rolling radius of the wheels, m. Default: 0.315.")
]
FrontDrive = Annotated[
    float | None, typer.Option(help="Share of the drive torque on the front axle. Default: 1.")
]
