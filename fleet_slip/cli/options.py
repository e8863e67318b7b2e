"""Options that several commands share: a selection as one parameter, and what is examined."""

import functools
import inspect
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import MISSING, fields
from typing import Annotated, Any, TypeVar

import typer

from fleet_slip.api.calls import documented, type_of
from fleet_slip.cli.completing import complete_config, complete_feature_set, complete_model
from fleet_slip.dates import date_of, last_day
from fleet_slip.errors import UsageError
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.regression.inference.drive_moments import ClusterUnit
from fleet_slip.selection.request import SelectionRequest

R = TypeVar("R")

DETAILS: dict[str, dict[str, Any]] = {
    "campaign": {"autocompletion": complete_config("campaigns")},
    "days": {"min": 1},
    "features": {"autocompletion": complete_feature_set},
    "folds": {"metavar": "NUMBER|each"},
    "mapping": {"autocompletion": complete_config("mappings")},
    "models": {"autocompletion": complete_config("models")},
    "most": {"min": 1, "max": 200},
    "repeat": {"min": 2},
    "bootstrap": {"min": 100},
}
"""What options need on the command line beside what is said of the fields of requests."""

READ: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "campaign": (str, str),
    "folds": (str | None, lambda folds: folds),
    "landing": (str, str),
    "night": (str | None, lambda night: date_of(night, "--night")),
    "through": (str | None, last_day),
}
"""Fields of other types on the command line, and what reads them."""

RESAMPLING = ("repeat", "bootstrap")
"""Fields that tell more of a winner and choose none."""


def option(request: type, name: str, *names: str) -> Any:
    """Return the option for a field of a request, under other names if these are given."""
    told = documented(request)
    text = _NAMED.sub(lambda one: "--" + one[1].replace("_", "-"), told[name])
    default = next(one.default for one in fields(request) if one.name == name)
    alone = (f"--{name.replace('_', '-')}",) if default is False else ()
    return typer.Option(*(names or alone), help=text, **DETAILS.get(name, {}))


_NAMED = re.compile("`([a-z_]+)`")


def request_options(
    request: type, *, without: Collection[str] = (), **names: str
) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command the options of a request in place of its parameter of that type.

    `names` are options that are called otherwise than their fields.
    """
    given = [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if one.default is MISSING else one.default,
            annotation=Annotated[
                READ[one.name][0] if one.name in READ else type_of(one.type),
                option(request, one.name, *filter(None, [names.get(one.name)])),
            ],
        )
        for one in fields(request)
        if one.name in documented(request) and one.name not in without
    ]

    def expand(command: Callable[..., R]) -> Callable[..., R]:
        own = inspect.signature(command).parameters.values()
        taken = next(one.name for one in own if one.annotation is request)
        parameters = [
            each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for one in own
            for each in (given if one.name == taken else [one])
        ]

        @functools.wraps(command)
        def run(**values: Any) -> R:
            chosen = {one.name: values.pop(one.name) for one in given}
            read = {name: READ[name][1](chosen[name]) for name in chosen.keys() & READ.keys()}
            return command(**values, **{taken: request(**chosen | read)})

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        return run

    return expand


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
FoldCount = Annotated[str | None, option(SelectionRequest, "folds")]
Worth = Annotated[str | None, option(SelectionRequest, "worth")]
Naive = Annotated[bool, option(SelectionRequest, "naive")]
Cluster = Annotated[ClusterUnit | None, option(SelectionRequest, "cluster")]
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
