"""Functions run at once, each in a new process of its own."""

import multiprocessing
from collections.abc import Callable, Iterable
from typing import Any

from tests.support.commands import PATIENCE_S

PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["fleet_slip.api.fleet"])  # once, for all that are forked


def call_at_once(function: Callable[..., object], arguments: Iterable[tuple[Any, ...]]) -> None:
    """Call a function with each of the arguments; an `AssertionError` if one fails or hangs."""
    processes = [PROCESSES.Process(target=function, args=one, daemon=True) for one in arguments]
    for process in processes:
        process.start()
    for process in processes:
        process.join(PATIENCE_S)
    codes = [process.exitcode for process in processes]
    for process in processes:
        process.kill()
    assert codes == [0] * len(processes), codes
