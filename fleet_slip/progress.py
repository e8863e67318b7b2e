"""How long work tells of its progress."""

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with the units done since the last call, and the units to do in all: rows or bytes."""


def no_progress(_more: int, _all: int) -> None:
    """Tell nobody."""
