"""The command that brings a published version into other programs: export."""

from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.export.files import Target


def export(
    context: typer.Context,
    to: Annotated[Target, typer.Option(help="What to export to.")],
    model: OnlyModel = None,
    output: Annotated[
        Path, typer.Option(help="Folder to write into; files of the same names are replaced.")
    ] = Path(),
    with_gram: Annotated[
        bool,
        typer.Option("--with-gram", help="With --to c: also what counts Gram rows in the car."),
    ] = False,
    json: Json = False,
) -> None:
    """Write a version as a program for elsewhere, with checks: vectors of inputs and angles.

    Example: **fleet-slip export waterford --to c --output export**
    """
    written = context.obj.export(model, to, output, with_gram=with_gram)
    if json:
        print_json({"files": [str(path) for path in written]})
        return
    for path in written:
        say(f"{path}: {path.stat().st_size:,} bytes")
