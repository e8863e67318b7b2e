"""Commands that show: report, watch, explore."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.completing import complete_config
from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.cli.workers import Threads
from fleet_slip.extras import needed
from fleet_slip.resources import folder


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
    output: Annotated[Path, typer.Option(help="The page, .html, which plays in a browser.")] = Path(
        "watch.html"
    ),
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


def explore(
    context: typer.Context,
    edit: Annotated[
        bool, typer.Option("--edit", help="Show the code, and let it be changed.")
    ] = False,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of this machine.", show_default=False)
    ] = None,
    headless: Annotated[
        bool, typer.Option("--headless", help="Open no browser; say the address.")
    ] = False,
) -> None:
    """Look at a data root in the browser: cohorts by mouse, error maps, coefficients, drift.

    A marimo notebook, which runs until it is interrupted.

    Example: **fleet-slip explore --headless**
    """
    with needed("explore", "the notebook"):
        import altair  # noqa: F401, PLC0415 - an extra
        import marimo  # noqa: F401, PLC0415
        import numba  # noqa: F401, PLC0415
    context.obj.warehouse.require()
    words = ["edit" if edit else "run", str(folder("jobs") / "explore.py")]
    words += [*(["--port", str(port)] if port else []), *(["--headless"] if headless else [])]
    command = [sys.executable, "-m", "marimo", *words, "--", "--root", str(context.obj.root)]
    os.execv(command[0], command)  # noqa: S606 - the notebook takes the place of this process
