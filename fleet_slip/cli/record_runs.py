"""Marks the commands that change the warehouse: each leaves a record in the history of runs."""

import functools
import sys
from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import typer

from fleet_slip.runs.log import recording

P = ParamSpec("P")
R = TypeVar("R")


def record_run(command: Callable[P, R]) -> Callable[P, R]:
    """Return the command, recorded. Its `context` parameter carries the warehouse."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> R:
        context = cast(typer.Context, options["context"])
        with recording(context.obj.root, command.__name__, sys.argv[1:]):
            return command(*arguments, **options)

    return run
