"""Commits that meet: how one is told, and how it is tried again."""

import random
import re
import time
from collections.abc import Callable
from typing import TypeVar

from deltalake.exceptions import CommitFailedError

from fleet_slip.errors import ConflictError

ATTEMPTS = 12
FIRST_WAIT_S = 0.02
LONGEST_WAIT_S = 5.0

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


def retry_conflicts(attempt: Callable[[], Result]) -> Result:
    """Call until it raises no `ConflictError`, waiting ever longer between, at random.

    The last conflict is raised. "Full jitter": processes that met once do not meet again.
    """
    for number in range(ATTEMPTS - 1):
        try:
            return attempt()
        except ConflictError:
            longest = min(FIRST_WAIT_S * 2**number, LONGEST_WAIT_S)
            time.sleep(random.uniform(0, longest))  # noqa: S311 - not a secret
    return attempt()
