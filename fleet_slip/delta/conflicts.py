"""Commits in conflict: how one is recognised, and how it is tried again."""

import random
import re
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

from deltalake.exceptions import CommitFailedError

from fleet_slip.errors import ConflictError, StorageError

if TYPE_CHECKING:
    from fleet_slip.delta.table import Table

ATTEMPTS = 12
FIRST_WAIT_S = 0.02
LONGEST_WAIT_S = 5.0
LOOKS = 8
"""So often tables are looked at again that do not rest."""

_CONFLICT = re.compile(
    r"concurrent|changed since last commit|existing table version|already exists|"
    r"exceeded maximum commit attempts|^Failed to commit transaction: \d+$",
    re.IGNORECASE,
)
"""What the Delta library says when another commit was faster; anything else is a fault."""

Result = TypeVar("Result")


def is_conflict(error: CommitFailedError) -> bool:
    """Whether a commit failed because another one was faster."""
    return _CONFLICT.search(str(error)) is not None


def on_newest(
    tables: Sequence["Table"],
    look: Callable[[], Result],
    is_damage: Callable[[Result], bool] = lambda _: False,
) -> Result:
    """Look at tables, and again if what is found may be of files that a newer version removed.

    Damage, or a `StorageError`, is told only if the tables rested meanwhile, or never rest.
    """
    for _ in range(LOOKS):
        before = _versions(tables)
        try:
            found = look()
            if not is_damage(found) or _versions(tables) == before:
                return found
        except StorageError:
            if _versions(tables) == before:
                raise
    return look()


def _versions(tables: Sequence["Table"]) -> list[int | None]:
    found: list[int | None] = []
    for table in tables:
        try:
            delta = table.open_delta()
        except StorageError:
            delta = None
        found.append(None if delta is None else delta.version())
    return found


def retry_conflicts(attempt: Callable[[], Result]) -> Result:
    """Call until it raises no `ConflictError`, waiting ever longer, at random, between."""
    for number in range(ATTEMPTS - 1):
        try:
            return attempt()
        except ConflictError:
            longest = min(FIRST_WAIT_S * 2**number, LONGEST_WAIT_S)
            time.sleep(random.uniform(0, longest))  # noqa: S311 - not a secret
    return attempt()
