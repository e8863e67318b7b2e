"""The command that writes the report."""

from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.output import Json, print_json, say


def report(
    context: typer.Context,
    model: OnlyModel = None,
    output: Annotated[
        Path | None,
        typer.Option(help="Folder. Default: report/ in the data root.", show_default=False),
    ] = None,
    json: Json = False,
) -> None:
    """Write one page that lays our figures beside the paper's, from the latest evaluation.

    The page needs nothing but itself; the same figures stand beside it as SVG and PNG files.

    Example: **fleet-slip report waterford**
    """
    written = context.obj.report(model, output)
    if json:
        print_json(written)
    else:
        say(
            f"{written.page}: {written.size_bytes / 1e6:.1f} MB, {written.figures} figures, "
            f"which are in {written.figures_folder} too"
        )
