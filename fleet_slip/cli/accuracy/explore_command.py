"""The command that opens a data root as a notebook."""

import os
import sys
from typing import Annotated

import typer

from fleet_slip.extras import needed
from fleet_slip.resources import folder
from fleet_slip.warehouse.minimum_cohort import require_single_cars


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
    require_single_cars("the notebook", "Ask select, which counts the cars.")
    with needed("explore", "the notebook"):
        import altair  # noqa: F401, PLC0415 - an extra
        import marimo  # noqa: F401, PLC0415
        import numba  # noqa: F401, PLC0415
    context.obj.warehouse.require()
    words = ["edit" if edit else "run", str(folder("jobs") / "explore.py")]
    words += [*(["--port", str(port)] if port else []), *(["--headless"] if headless else [])]
    command = [sys.executable, "-m", "marimo", *words, "--", "--root", str(context.obj.root)]
    os.execv(command[0], command)  # noqa: S606 - the notebook takes the place of this process
