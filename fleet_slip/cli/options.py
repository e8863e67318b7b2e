"""Options that several commands share: a selection as one parameter, and what is examined."""

import functools
import inspect
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields
from typing import Annotated, Any, TypeVar

import typer

from fleet_slip.cli.completing import complete_config, complete_feature_set, complete_model
from fleet_slip.errors import UsageError
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.regression.choice.criteria import CRITERIA
from fleet_slip.regression.choice.signal_orders import RANKINGS
from fleet_slip.regression.choice.stepwise import METHODS
from fleet_slip.regression.inference.drive_moments import ClusterUnit
from fleet_slip.selection.model_list import DEFAULT_MOST
from fleet_slip.selection.request import DEFAULT_MODELS, LOGGED_MODELS, SelectionRequest

R = TypeVar("R")

SELECTION: dict[str, Any] = {
    "models": typer.Option(
        help=f"A model list of configs/models, or a TOML file. Default: {DEFAULT_MODELS}, or "
        f"{LOGGED_MODELS} with --features, unless --nested or an option that searches is given.",
        autocompletion=complete_config("models"),
        show_default=False,
    ),
    "model": typer.Option(
        help="The inputs of the one model to take, separated by commas, such as "
        '"ax, ay, yaw_rate", instead of a list.',
        show_default=False,
    ),
    "nested": typer.Option(
        help="Add the nested models of an order of signals, separated by commas; 'catalogue' is "
        "all inputs in the order of configs/signals.toml."
    ),
    "features": typer.Option(
        help="Feature set of configs/features.toml, computed before with: fleet-slip gram "
        "--features NAME. Default: what the list says, else the logged signals.",
        autocompletion=complete_feature_set,
    ),
    "label": typer.Option(
        help="course: learn without a reference sensor, from changes of the course over ground; "
        "course+sideslip: from these, and the label of the cars that have it. Feature set and "
        "model list are then those called course, unless others are named.",
        show_default=False,
    ),
    "by": typer.Option(
        help="What a fold is made of. Default: what the list says. By row is WEKA's way and leaks."
    ),
    "folds": typer.Option(
        "--folds",
        metavar="NUMBER|each",
        help="Number of folds, or each: every drive, or whatever folds are made of, is a fold of "
        "its own. Default: what the list says.",
    ),
    "rank": typer.Option(
        help=f"Rank the inputs of --nested first: {', '.join(RANKINGS)}. Default: declared.",
        show_default=False,
    ),
    "criterion": typer.Option(
        help="What decides how many of the ranked inputs are kept: cv (the smallest model that "
        f"falls negligibly short of the best; see --worth), {', '.join(CRITERIA)}. Default: cv.",
        show_default=False,
    ),
    "worth": typer.Option(
        "--worth",
        help="The smallest gain that is worth a signal: as an angle such as 0.025deg, the root of "
        "the difference of the mean squared errors, in which the label's noise cancels; or a share "
        "of the RMSE, such as 2%. Of the models that fall less short of the best, or by no more "
        "than one standard error of the difference, that with the fewest signals wins. "
        "Default: 0.025deg, or the rule of the list.",
        show_default=False,
    ),
    "all_subsets": typer.Option(
        "--all-subsets", help="Search all subsets of the inputs of --nested instead of an order."
    ),
    "robust": typer.Option(
        "--robust",
        help="Leave out the cars whose influence on the model no honest car of their rows has, and "
        "say which; diagnose says it before.",
    ),
    "naive": typer.Option(
        "--naive",
        help="Take rows for independent evidence, not drives or cars. At 100 Hz they are not: "
        "then every criterion keeps nearly everything.",
    ),
    "cluster": typer.Option(
        help="What is independent evidence: vehicle, since a car's drives share its biases and "
        "tyres, or drive. Default: vehicle where there are several, else drive.",
        show_default=False,
    ),
    "intercept": typer.Option(
        help="Whether models have an intercept. Without it they go through the origin: a car that "
        "drives straight on then has no side-slip, and no sensor an offset."
    ),
    "search": typer.Option(
        "--search",
        help=f"Search among the inputs of --nested, or all: {', '.join(METHODS)}; the search is "
        "made again in every fold. Adds its models of 1, 2, ... columns.",
        show_default=False,
    ),
    "most": typer.Option(
        min=1, max=200, help=f"Most columns of --search. Default: {DEFAULT_MOST}."
    ),
    "repeat": typer.Option(
        min=2, help="Cross-validate the winner again with so many other deals of folds."
    ),
    "bootstrap": typer.Option(
        min=100,
        help="Confidence interval of the winner's correlation by drawing the drives so many times.",
    ),
}
"""The option of each field of `SelectionRequest`, which has their types and defaults."""

TEXTS = {"folds": str | None}
"""Fields that may be a number or a word: on the command line they are text."""

RESAMPLING = ("repeat", "bootstrap")
"""Fields that tell more of a winner and choose none."""

Models = Annotated[
    str,
    typer.Option(
        help="A model list of configs/models, or a TOML file.",
        autocompletion=complete_config("models"),
    ),
]
Cohort = Annotated[
    str,
    typer.Option(help="SQL condition on the view drives, such as \"track = 'waterford_hills'\"."),
]
Unexamined = Annotated[
    bool,
    typer.Option(
        "--unexamined",
        help="Take drives whose sensors are not in order, too. As a rule all are examined first.",
    ),
]
By = Annotated[FoldKey, typer.Option(help="What a fold is made of.")]
FoldCount = Annotated[str | None, SELECTION["folds"]]
Worth = Annotated[str | None, SELECTION["worth"]]
Naive = Annotated[bool, SELECTION["naive"]]
Cluster = Annotated[ClusterUnit | None, SELECTION["cluster"]]


def selection_options(
    *, without: Collection[str] = ()
) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command the options of a selection in place of its parameter `SelectionRequest`."""
    given = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default,
            annotation=Annotated[TEXTS.get(field.name, field.type), SELECTION[field.name]],
        )
        for field in fields(SelectionRequest)
        if field.name not in without
    ]

    def expand(command: Callable[..., R]) -> Callable[..., R]:
        own = inspect.signature(command).parameters.values()
        request = next(one.name for one in own if one.annotation is SelectionRequest)
        parameters = [
            each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for one in own
            for each in (given if one.name == request else [one])
        ]

        @functools.wraps(command)
        def run(**values: Any) -> R:
            chosen = {one.name: values.pop(one.name) for one in given}
            return command(**values, **{request: SelectionRequest(**chosen)})

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        return run

    return expand


Model = Annotated[
    str | None,
    typer.Argument(
        metavar="MODEL",
        help="NAME, NAME@VERSION or NAME@ALIAS of a published model. Default: the only one that "
        "there is, unless --signals is given.",
        autocompletion=complete_model,
        show_default=False,
    ),
]
Signals = Annotated[
    str | None,
    typer.Option(
        help="Instead of a published model: signals to fit, separated by commas; 'catalogue' is "
        "all inputs."
    ),
]
FeatureSetOption = Annotated[
    str | None,
    typer.Option(
        "--features", help="Feature set that --signals are of. Default: the logged signals."
    ),
]


def quantities(values: Sequence[str] | None, option: str) -> dict[str, float]:
    """Return what options like `--noise ay=0.2` say, in SI units. Raises `UsageError`."""
    found = {}
    for value in values or ():
        name, _, number = value.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            raise UsageError(
                f"{option} {value}: write SIGNAL=NUMBER in SI units, such as ay=0.2."
            ) from None
    return found
