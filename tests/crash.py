"""Runs the command line and kills it (SIGKILL) at a chosen call that makes something durable.

    python -m tests.crash NUMBER COMMAND...    die at call NUMBER; with 0 count the calls and live

Every call is a point twice: before it takes effect, and after.
"""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from deltalake import DeltaTable

from fleet_slip.cli.main import main

POINTS: tuple[tuple[Any, str], ...] = (
    (pq, "write_table"),
    (os, "fsync"),
    (Path, "replace"),
    (Path, "hardlink_to"),
    (Path, "mkdir"),
    (DeltaTable, "create"),
    (DeltaTable, "create_write_transaction"),
)


class Countdown:
    """Counts the points that were passed and kills the process at one of them."""

    def __init__(self, fatal: int) -> None:
        self.fatal = fatal
        self.passed = 0

    def point(self) -> None:
        self.passed += 1
        if self.passed == self.fatal:
            os.kill(os.getpid(), signal.SIGKILL)

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            self.point()
            result = function(*arguments, **options)
            self.point()
            return result

        return wrapped


def run() -> None:
    countdown = Countdown(int(sys.argv[1]))
    for owner, name in POINTS:
        setattr(owner, name, countdown.around(getattr(owner, name)))
    sys.argv = ["fleet-slip", *sys.argv[2:]]
    try:
        main()
    finally:
        if not countdown.fatal:
            sys.stdout.write(f"\npoints {countdown.passed}\n")


if __name__ == "__main__":
    run()
