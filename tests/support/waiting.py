"""Waiting for what must happen, for a while."""

import time
from collections.abc import Callable

from tests.support.commands import PATIENCE_S


def until(condition: Callable[[], object], seconds: float = PATIENCE_S) -> None:
    """Wait until the condition holds; an `AssertionError` if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds:.0f} s in vain"
        time.sleep(0.02)
