"""What calls of a `Fleet` share: their record, their progress, and where their tasks run."""

import functools
import inspect
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Concatenate,
    ParamSpec,
    TypedDict,
    TypeVar,
    get_args,
    get_origin,
)

from typing_extensions import Doc

from fleet_slip.base import Progress, no_progress, require_extra
from fleet_slip.catalog.drive_sources import TRAINING_DRIVES
from fleet_slip.compute.tasks import LocalThreads
from fleet_slip.models.request import DEFAULT_MODELS, TOLERANCE
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import current_run_id, recording

if TYPE_CHECKING:
    from fleet_slip.warehouse.warehouse import Warehouse


class Rooted:
    """The warehouse of a data root. Making one touches nothing."""

    def __init__(self, warehouse: "Warehouse") -> None:
        self.warehouse = warehouse

    @property
    def root(self) -> Folder:
        """The data root: a folder, or a place on an object store."""
        return self.warehouse.root

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r})"


ShowProgress = Callable[[int, int], None]
"""Called now and then with the units done so far and the units to do in all: rows, bytes, files."""

ShowStep = Callable[[str, int, int], None]
"""Like `ShowProgress`, with the name of the step first."""

Workers = int | str | Executor | None
"""Where tasks run, with the same result: threads of this process (None: one a core), the address of
a Dask scheduler such as `tcp://10.0.0.1:8786`, or an executor.
"""

S = TypeVar("S", bound=Rooted)
P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")


def record_call(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Return the method, each call of which leaves a record, unless a command has one already.

    A dry run changes nothing, and leaves none.
    """

    @functools.wraps(method)
    def call(self: S, /, *arguments: P.args, **options: P.kwargs) -> R:
        if current_run_id() is not None or options.get("dry_run"):
            return method(self, *arguments, **options)
        with recording(self.root, method.__name__, _as_typed(arguments, options)):
            return method(self, *arguments, **options)

    call.recorded = True  # type: ignore[attr-defined]
    return call


def takes(
    options: Callable[P, T],
) -> Callable[[Callable[[S, T], R]], Callable[Concatenate[S, P], R]]:
    """Let a method take the fields of a dataclass of options, and say what they are."""

    def expand(method: Callable[[S, T], R]) -> Callable[Concatenate[S, P], R]:
        @functools.wraps(method)
        def call(self: S, /, *arguments: P.args, **chosen: P.kwargs) -> R:
            return method(self, options(*arguments, **chosen))

        own = inspect.signature(method)
        first = next(iter(own.parameters.values()))
        given = inspect.signature(options).parameters.values()
        signature = own.replace(parameters=[first, *given])
        call.__signature__ = signature  # type: ignore[attr-defined]
        return call

    return expand


def doc_of(annotation: Any) -> str | None:
    """Return what is said of a parameter, if anything is: then it is an option of a command."""
    notes = getattr(annotation, "__metadata__", ())
    return next((one.documentation for one in notes if isinstance(one, Doc)), None)


def type_of(annotation: Any) -> Any:
    """Return a type without what is said of it."""
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _as_typed(arguments: Sequence[object], options: Mapping[str, object]) -> list[str]:
    """Return the arguments of a call as one types them, so that the history leaves out the same."""
    typed = [text for argument in arguments for text in _texts(argument)]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        typed += [option] if value is True else [f"{option}={text}" for text in _texts(value)]
    return typed


def _texts(value: object) -> list[str]:
    match value:
        case None | bool():
            return []
        case str() | int() | float() | Path() | date():
            return [str(value)]
        case list() | tuple():
            return [text for item in value for text in _texts(item)]
        case _:
            return [str(name)] if (name := getattr(value, "name", None)) else []


def count_from_start(show: ShowProgress | None) -> Progress:
    """Return what a job calls with what is newly done; it shows what is done since the start."""
    if show is None:
        return no_progress
    done = 0

    def progress(more: int, total: int) -> None:
        nonlocal done
        done += more
        show(done, total)

    return progress


def of_step(show: ShowStep | None, name: str) -> ShowProgress | None:
    """Return what shows the progress of a step."""
    return None if show is None else lambda done, total: show(name, done, total)


@contextmanager
def open_workers(root: Folder, workers: Workers) -> Iterator[Executor]:
    """Yield the executor that `workers` means; a given one stays open. Raises `ExtraError`."""
    context: Any
    if isinstance(workers, Executor):
        context = nullcontext(workers)
    elif isinstance(workers, str):
        with require_extra("cluster", "a cluster"):
            from fleet_slip.compute.cluster import cluster_executor  # slow
        context = cluster_executor(workers, absolute(root))
    else:
        context = LocalThreads(workers or os.cpu_count() or 1)
    with context as executor:
        yield executor


def absolute(root: Folder) -> Folder:
    """Return a root that means the same in other working directories, such as a worker's."""
    from fleet_slip.storage.local import LocalFolder

    return LocalFolder(root.path.absolute()) if isinstance(root, LocalFolder) else root


def unless_local(executor: Executor) -> Executor | None:
    """Return the executor if it is of other processes, for what uses all cores of its own."""
    return None if isinstance(executor, ThreadPoolExecutor) else executor


def within_reach(warehouse: "Warehouse", executor: Executor) -> "Warehouse":
    """Return the warehouse as the workers of an executor find it.

    It is pickled with its catalog: a worker need not have the folder of configs.
    """
    from fleet_slip.warehouse.warehouse import Warehouse

    if unless_local(executor) is None:
        return warehouse
    return Warehouse(absolute(warehouse.root), warehouse.configs)


# What is said of parameters of several methods; with a `Doc` they are options of commands, too.

COHORT = Doc("SQL predicate on the view drives, such as \"track = 'waterford_hills'\".")
UNEXAMINED = Doc("Use drives with faulty sensors, too. By default they are left out.")
MODEL = Doc(
    "NAME, NAME@VERSION or NAME@ALIAS of a published model; NAME alone is its champion. Default: "
    "the only one that there is."
)
VERSION = Doc("NAME, NAME@VERSION or NAME@ALIAS. NAME alone is its champion.")
ALIAS = Doc("The alias to move.")
CAMPAIGN = Doc("A campaign of configs/campaigns, or the path of a TOML file.")
DAYS = Doc("Simulate the first N days only. Default: all.")
THROUGH = Doc("Last day to simulate, YYYY-MM-DD or today. Default: all days.")
MODELS = Doc("A model list of configs/models, or a TOML file.")


class CarMeasures(TypedDict, total=False):
    """What scales and a tape measure say of a car."""

    mass_kg: Annotated[float | None, Doc("Of the whole car with its driver, kg.")]
    front_axle_m: Annotated[float | None, Doc("From the centre of gravity to the front axle, m.")]
    rear_axle_m: Annotated[float | None, Doc("To the rear axle, m.")]
    track_m: Annotated[float | None, Doc("m. Default: 1.55.")]
    height_m: Annotated[float | None, Doc("Of the centre of gravity, m. Default: 0.55.")]
    rolling_radius_m: Annotated[float | None, Doc("Of the wheels, m. Default: 0.315.")]
    front_drive_share: Annotated[float | None, Doc("Part of the drive torque. Default: 1.")]


@dataclass(frozen=True)
class NightRequest:
    """What `Fleet.nightly` takes."""

    landing: Annotated[Path | str, Doc("Inbox folder of logs; new logs in it are loaded.")]
    mapping: Annotated[
        str,
        Doc("A mapping: of configs/mappings, or a TOML file."),
    ]
    name: Annotated[str, Doc("Name of the model.")]
    _: KW_ONLY
    cohort: Annotated[str, Doc("SQL predicate on the view drives: which drives train it.")] = (
        TRAINING_DRIVES
    )
    models: Annotated[str, MODELS] = DEFAULT_MODELS
    tolerance: Annotated[str | None, TOLERANCE] = None
    candidate: Annotated[bool, Doc("Publish as a candidate, even what is not worse.")] = False
    retention: Annotated[
        str | None, Doc("A retention file. Default: retention.toml of the configs.")
    ] = None
    night: Annotated[date | str | None, Doc("Date of the night, YYYY-MM-DD. Default: today.")] = (
        None
    )
    workers: Workers = None
    progress: ShowStep | None = None
