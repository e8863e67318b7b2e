"""Where a command's tasks run: threads of this process, or the workers of a Dask cluster."""

from typing import Annotated

import typer

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
