"""The command that shows a drive."""

from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.completing import complete_config
from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.output import say
from fleet_slip.cli.workers import Threads


def watch(
    context: typer.Context,
    what: Annotated[
        str,
        typer.Argument(
            help="A scenario of configs/scenarios, the path of one, or a drive of the logs.",
            metavar="SCENARIO|DRIVE",
            autocompletion=complete_config("scenarios"),
            show_default=False,
        ),
    ],
    model: OnlyModel = None,
    output: Annotated[
        Path, typer.Option(help="File: .html plays in a browser, .mp4 and .gif are films.")
    ] = Path("watch.html"),
    begin: Annotated[float, typer.Option("--from", help="First second that is shown.")] = 0.0,
    until: Annotated[
        float | None, typer.Option(help="Last second. Default: the last.", show_default=False)
    ] = None,
    threads: Threads = None,
) -> None:
    """Show a drive: the car on its track, its true and its estimated angle, wheels and gates.

    The page is one file and needs no server.

    Example: **fleet-slip watch adhesion_0_4 --output slippery.html**
    """
    file = context.obj.watch(what, model, output, from_s=begin, until_s=until, threads=threads)
    from fleet_slip.pages.page_parts import size  # noqa: PLC0415 - of the extra, which is there now

    say(f"{file}: {size(file.stat().st_size)}")
