"""Where a command's tasks run: threads of this process, or the workers of a Dask cluster."""

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Annotated

import typer

from fleet_slip.compute.tasks import LocalThreads
from fleet_slip.errors import ConfigError
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.warehouse.tables import Warehouse

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


@contextmanager
def workers(
    context: typer.Context, cluster: str | None, threads: int | None = None
) -> Iterator[tuple[Warehouse, Executor]]:
    """Yield the warehouse and the executor for a command.

    Raises `ConfigError` if a cluster is wanted and Dask is not installed, and what
    `cluster_executor` raises.
    """
    warehouse: Warehouse = context.obj
    if not cluster:
        with LocalThreads(threads or os.cpu_count() or 1) as executor:
            yield warehouse, executor
        return
    try:
        from fleet_slip.compute.cluster import cluster_executor  # noqa: PLC0415 - an extra, and slow
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--cluster needs the package {error.name}: pip install 'fleet-slip[cluster]'"
        ) from None
    root = warehouse.root
    if isinstance(root, LocalFolder):  # a worker has a working directory of its own
        root = LocalFolder(root.path.absolute())
    with cluster_executor(cluster, root) as executor:
        yield Warehouse(root), executor


def unless_local(executor: Executor) -> Executor | None:
    """Return the executor if it is of other processes, for what uses all cores of its own."""
    return None if isinstance(executor, LocalThreads) else executor
