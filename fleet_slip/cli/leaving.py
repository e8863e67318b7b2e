"""What is said where the program ends before its modules are imported, by nothing but Python."""

import contextlib
import json
import os
import sys
from datetime import UTC, datetime
from typing import Any

from fleet_slip.errors import INTERRUPTED

LOG_VARIABLE = "FLEET_SLIP_LOG"


def tell(text: str, level: str) -> None:
    """Print a remark on stderr: for people on a terminal, else one JSON object."""
    wanted = os.environ.get(LOG_VARIABLE, "auto")
    if wanted == "text" or (wanted != "json" and sys.stderr is not None and sys.stderr.isatty()):
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
