"""Ends the program with a message before its modules are imported, by Python alone."""

import contextlib
import os
from typing import Any

from fleet_slip.errors import INTERRUPTED


def tell(text: str) -> None:
    """Print a remark on stderr."""
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode())


def leave(_signal: int, _frame: Any) -> None:
    """End at once: what answers Ctrl-C while modules are imported, which not all survive."""
    tell("interrupted: nothing was done yet.")
    os._exit(INTERRUPTED)
