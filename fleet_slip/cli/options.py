"""Options of commands: those of a request as one parameter, and some that several share."""

import functools
import inspect
import os
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from fleet_slip.api.calls import documented, type_of
from fleet_slip.base import date_of, last_day
from fleet_slip.errors import FleetSlipError, UsageError
from fleet_slip.resources import CONFIG_VARIABLE, config_names

# What Tab completes in a shell of the system: names of models, campaigns, lists and feature sets.
#
# Completion never fails and never speaks: where names cannot be read, there are none.

Complete = Callable[[typer.Context, str], list[str]]


def complete_model(context: typer.Context, incomplete: str) -> list[str]:
    """Return the models that a word may become, or the versions of one after its @."""
    import fleet_slip  # noqa: PLC0415 - completion of other words need not wait for it
    from fleet_slip.models.registry import Registry  # noqa: PLC0415

    options = context.find_root().params
    try:
        registry = Registry(fleet_slip.open(options.get("root")).root / "models")
        name, at, _ = incomplete.partition("@")
        if at and name in registry.names():
            versions = [str(number) for number in reversed(registry.versions(name))]
            found = [f"{name}@{one}" for one in (*registry.history(name).aliases(), *versions)]
        else:
            found = registry.names()
    except (FleetSlipError, OSError):
        return []
    return [one for one in found if one.startswith(incomplete)]


def complete_config(kind: str) -> Complete:
    """Return what completes the names of the configs of one kind, such as `campaigns`."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        _lay_over_configs(context)
        try:
            return [name for name in config_names(kind) if name.startswith(incomplete)]
        except (FleetSlipError, OSError):
            return []

    return complete


def complete_feature_set(context: typer.Context, incomplete: str) -> list[str]:
    """Return the feature sets that a word may become."""
    from fleet_slip.catalogue.features import (  # noqa: PLC0415
        PLAIN,
        features,
    )

    _lay_over_configs(context)
    try:
        return [name for name in (PLAIN, *features().sets) if name.startswith(incomplete)]
    except (FleetSlipError, OSError):
        return []


def _lay_over_configs(context: typer.Context) -> None:
    own = context.find_root().params.get("config")
    if own is not None:
        os.environ[CONFIG_VARIABLE] = str(Path(own).absolute())


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
    "bias": (list[str] | None, lambda values: quantities(values, "--bias")),
    "folds": (str | None, lambda folds: folds),
    "landing": (str, str),
    "model": (str | None, lambda model: model),
    "night": (str | None, lambda night: date_of(night, "--night")),
    "noise": (list[str] | None, lambda values: quantities(values, "--noise")),
    "over": (str | None, lambda over: [one.strip() for one in over.split(",")] if over else ()),
    "through": (str | None, last_day),
}
"""Fields of other types on the command line, and what reads them."""

RESAMPLING = ("repeat", "bootstrap")
"""Fields that tell more of a winner and choose none."""


def option(request: type, name: str, *names: str, argument: bool = False) -> Any:
    """Return the option for a field of a request, under other names if these are given.

    As an `argument` it is a published model.
    """
    told = documented(request)
    text = _NAMED.sub(lambda one: "--" + one[1].replace("_", "-"), told[name])
    if argument:
        return typer.Argument(metavar="MODEL", help=text, autocompletion=complete_model)
    default = next(one.default for one in fields(request) if one.name == name)
    alone = (f"--{name.replace('_', '-')}",) if default is False else ()
    return typer.Option(*(names or alone), help=text, **DETAILS.get(name, {}))


_NAMED = re.compile("`([a-z_]+)`")


def request_options(
    request: type, *, without: Collection[str] = (), argument: str = "", **names: str
) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command the options of a request in place of its parameter of that type.

    `names` are options that are called otherwise than their fields; the `argument` names a model.
    """
    given = [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            default={MISSING: inspect.Parameter.empty, (): None}.get(one.default, one.default),
            annotation=Annotated[
                READ[one.name][0] if one.name in READ else type_of(one.type),
                option(
                    request,
                    one.name,
                    *filter(None, [names.get(one.name)]),
                    argument=one.name == argument,
                ),
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


# Where a command's tasks run: threads of this process, or the workers of a Dask cluster.

CLUSTER_VARIABLE = "DASK_SCHEDULER_ADDRESS"

Threads = Annotated[
    int | None,
    typer.Option(
        min=1, help="Threads of this machine. The result is the same. Default: all cores."
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        envvar=CLUSTER_VARIABLE,
        metavar="ADDRESS",
        help="Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers do the work; "
        "they must share the data root. Default: threads of this machine.",
        show_default=False,
    ),
]


# The argument that names a published model, for commands that wait for nothing else.

OnlyModel = Annotated[
    str | None,
    typer.Argument(
        metavar="MODEL",
        help="NAME, NAME@VERSION or NAME@ALIAS of a published model; NAME alone is its champion. "
        "Default: the only one that there is.",
        autocompletion=complete_model,
        show_default=False,
    ),
]
