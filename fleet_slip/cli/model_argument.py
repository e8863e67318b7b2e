"""The argument that names a published model, for commands that wait for nothing else."""

from typing import Annotated

import typer

from fleet_slip.cli.completing import complete_model

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
