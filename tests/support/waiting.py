"""Waiting for what must happen, for a while."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.support.commands import PATIENCE_S


def until(condition: Callable[[], object], seconds: float = PATIENCE_S) -> None:
    """Wait until the condition holds; an `AssertionError` if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds:.0f} s in vain"
        time.sleep(0.02)


class LateError(BaseException):
    """Something hangs; not an `Exception`, which what hangs may catch."""


@contextmanager
def within(seconds: int = int(PATIENCE_S)) -> Iterator[None]:
    """Raise `LateError` in what hangs; of the main thread."""

    def stop(*_: Any) -> None:
        raise LateError(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
