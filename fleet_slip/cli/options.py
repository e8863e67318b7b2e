"""Options of commands: those of a request as one parameter, and some that several share."""

import functools
import inspect
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Annotated, Any, get_args

import typer

from fleet_slip.api.calls import doc_of, open_workers, type_of
from fleet_slip.base import date_of, document_of, last_day
from fleet_slip.cli.output import Json, print_json, print_parts
from fleet_slip.storage.runs import recording

DETAILS: dict[str, dict[str, Any]] = {
    "days": {"min": 1},
    "folds": {"metavar": "NUMBER|each"},
    "max_age_hours": {"min": 0},
    "max_features": {"min": 1, "max": 200},
    "retention_hours": {"min": 1, "max": 168},
    "target_rows": {"min": 1},
    "what": {"metavar": "SCENARIO|DRIVE"},
}
"""What options need on the command line beside what is said of them in the API."""

NAMES = {
    "predicate": "--cohort",
    "everything": "--all",
    "front_drive_share": "--front-drive",
    "rolling_radius_m": "--radius",
}
"""Parameters that every command calls otherwise than the API; units are in the help of an option,
not in its name."""

READ: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "campaign": (str, str),
    "folds": (str | None, lambda folds: folds),
    "landing": (str, str),
    "logs": (list[str], list),
    "mapping": (str, lambda mapping: mapping),
    "model": (str | None, lambda model: model),
    "night": (str | None, lambda night: date_of(night, "--night")),
    "one": (str, str),
    "other": (str, str),
    "others": (list[str] | None, lambda names: names or ()),
    "over": (str | None, lambda over: [one.strip() for one in over.split(",")] if over else ()),
    "scenarios": (list[str] | None, lambda names: names or ()),
    "accept_loss": (list[str] | None, lambda paths: paths or ()),
    "since": (str | None, lambda since: date_of(since, "--since")),
    "through": (str | None, last_day),
}
"""Parameters of other types on the command line, and what reads them."""

_NAMED = re.compile("`([a-z_]+)`")
_UNIT = re.compile("_(kg|m|s)$")


def command(
    *calls: Callable[..., Any],
    arguments: Collection[str] = (),
    without: Collection[str] = (),
    progress: str | None = None,
    echo: Collection[str] = (),
    **names: str,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function that prints an answer the command that asks for it.

    The answer is that of `calls`, methods of a `Fleet` and then of the answer before. Their
    parameters with a `Doc` are options of the command, or `arguments`, but for those `without`;
    `names` says which are called otherwise. Where their tasks run, are options if calls ask for it.
    With `--json` the document of the answer is printed, with the options of `echo` beside it,
    instead of calling the function, unless that has a parameter `json`. Its other parameters are
    options of its own, values of options, or `fleet`. While calls work their `progress` is shown:
    what is done, with options in braces, or "" where calls name their steps. What changes the
    warehouse leaves a record. The `problem` of an answer is raised when all is printed.

    A function whose first parameter is `fleet` makes the calls, or others, and prints JSON, too.
    One without a parameter that is no option has nothing to add to the parts of an `Answer`.
    """
    names = NAMES | names
    asked = {
        name: one
        for call in calls
        for name, one in _parameters_of(call).items()
        if name not in without
    }
    given = {
        name: _parameter(one, name in arguments, names.get(name))
        for name, one in asked.items()
        if doc_of(one.annotation)
    }
    if "workers" in asked or "threads" in asked:
        given["threads"] = _plain("threads", Threads)
    if "workers" in asked:
        given["cluster"] = _plain("cluster", Cluster)

    def expand(show: Callable[..., None]) -> Callable[..., None]:
        others = [*inspect.signature(show).parameters.values()]
        renders = not others or others[0].default is not inspect.Parameter.empty
        first = None if renders else others.pop(0).name
        rest = {one.name for one in others if one.kind is inspect.Parameter.VAR_KEYWORD}
        own = {one.name for one in others} - rest
        beside = {
            one.name: one.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for one in others
            if one.name not in {"fleet", "json", *rest, *given}
        }
        context = _plain("context", typer.Context, inspect.Parameter.empty)
        parameters = [context, *given.values(), *beside.values()]
        if "json" not in without:
            parameters.append(_plain("json", Json, False))

        @functools.wraps(show)
        def run(context: typer.Context, *, json: bool = False, **typed: Any) -> None:
            fleet = context.obj()
            values = {
                name: READ[name][1](one) if name in READ and name in asked else one
                for name, one in typed.items()
            }
            dry_run = {**values, **typed}.get("dry_run")
            recorded = not dry_run and any(hasattr(call, "recorded") for call in calls)
            record = recording(fleet.root, show.__name__, sys.argv[1:]) if recorded else None
            known = {**values, "fleet": fleet, "json": json}
            known = {name: one for name, one in known.items() if name in own or rest}
            with record or nullcontext():
                if first == "fleet":
                    return show(**known | {"fleet": fleet})
                with _doing(fleet, asked, typed, progress) as working:
                    answer = fleet
                    for call in calls:
                        taken = _parameters_of(call)
                        options = {**values, **working}
                        answer = getattr(answer, call.__name__)(
                            **{name: one for name, one in options.items() if name in taken}
                        )
                if json and "json" not in own:
                    echoed = {names.get(one, one).strip("-"): values[one] for one in echo}
                    print_json(echoed | document_of(answer) if echo else answer)
                elif renders:
                    print_parts(answer.parts(**known))
                else:
                    show(answer, **known)
                if problem := getattr(answer, "problem", None):
                    raise problem

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        return run

    return expand


@contextmanager
def _doing(
    fleet: Any, asked: Collection[str], typed: Mapping[str, Any], doing: str | None
) -> Iterator[dict[str, Any]]:
    """Yield what calls need while they work: where tasks run, what shows how far they are."""
    found: dict[str, Any] = {}
    with ExitStack() as stack:
        if "workers" in asked:
            where = typed.get("cluster") or typed.get("threads")
            found["workers"] = stack.enter_context(open_workers(fleet.root, where))
        if doing is not None:
            from fleet_slip.cli import progress as bars  # noqa: PLC0415 - others wait for no bar

            named = doing.format(**typed)
            bar = bars.progress(named) if named else bars.progress_of_steps()
            found["progress"] = stack.enter_context(bar)
        yield found


def _parameters_of(call: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return what a call takes by name; instead of `**` the keys of its `TypedDict`."""
    found = dict(inspect.signature(call).parameters)
    for name, one in [*found.items()]:
        if one.kind is inspect.Parameter.VAR_KEYWORD:
            del found[name]
            [keys] = get_args(one.annotation)  # of `Unpack`
            found |= {key: _plain(key, kind) for key, kind in keys.__annotations__.items()}
    return found


def _parameter(one: inspect.Parameter, argument: bool, name: str | None) -> inspect.Parameter:
    """Return a parameter of the API as the command line has it."""
    text = _NAMED.sub(lambda found: "--" + found[1].replace("_", "-"), doc_of(one.annotation) or "")
    details: dict[str, Any] = {"help": text, **DETAILS.get(one.name, {})}
    if one.default is None or one.default is inspect.Parameter.empty:
        details["show_default"] = False
    if argument:
        if one.name == "model":
            details["metavar"] = "MODEL"
        said: Any = typer.Argument(**details)
    else:
        flag = _UNIT.sub("", one.name).replace("_", "-")
        off = f"/--no-{flag}" if one.default is True else ""
        said = typer.Option(name or f"--{flag}{off}", **details)
    kind = READ[one.name][0] if one.name in READ else type_of(one.annotation)
    left_out = one.default is inspect.Parameter.empty and type(None) in get_args(kind)
    default = None if left_out or one.default == () else one.default
    return _plain(one.name, Annotated[kind, said], default)


def _plain(name: str, annotation: Any, default: Any = None) -> inspect.Parameter:
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


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
