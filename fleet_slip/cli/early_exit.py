"""Ends the program with a message before its modules are imported, by Python alone."""

import contextlib
import json
import os
import sys
from datetime import UTC, datetime
from typing import Any

from fleet_slip.errors import INTERRUPTED

LOG_VARIABLE = "FLEET_SLIP_LOG"


def for_machines(wanted: str) -> bool:
    """Whether stderr is JSON: where it is asked for, beside `--json`, and in a systemd journal."""
    if wanted != "auto" or sys.stderr is None or sys.stderr.isatty():
        return wanted == "json"
    if "--json" in sys.argv:
        return True
    with contextlib.suppress(OSError):
        here = os.fstat(2)
        return os.environ.get("JOURNAL_STREAM") == f"{here.st_dev}:{here.st_ino}"
    return False


def tell(text: str, level: str) -> None:
    """Print a remark on stderr, for people or as one JSON object."""
    if not for_machines(os.environ.get(LOG_VARIABLE, "auto")):
        line = text
    else:
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        head = {"time": time, "level": level, "run_id": None, "event": "message"}
        line = json.dumps({**head, "message": text}, ensure_ascii=False)
    with contextlib.suppress(OSError):
        os.write(2, f"{line}\n".encode())


def leave(_signal: int, _frame: Any) -> None:
    """End at once: what answers Ctrl-C while modules are imported, which not all survive."""
    tell("interrupted: nothing was done yet.", "warning")
    os._exit(INTERRUPTED)
