"""Remarks and events on stderr: text for people, or one JSON object a line for machines."""

import json
import logging
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from fleet_slip.cli.early_exit import for_machines
from fleet_slip.errors import hide_passwords, printable
from fleet_slip.runs.log import LOGGER, current_run_id

if TYPE_CHECKING:
    from rich.console import Console


class LogFormat(StrEnum):
    """How remarks are written: `auto` is text, but JSON with `--json` and in journals."""

    AUTO = "auto"
    TEXT = "text"
    JSON = "json"


_drawn_on: "list[Console]" = []


def stderr() -> "Console":
    """Return a console for progress and remarks: that on which a bar is drawn, if there is one."""
    if _drawn_on:
        return _drawn_on[-1]
    from rich.console import Console  # noqa: PLC0415 - a command without a remark waits for none

    return Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)


@contextmanager
def drawing_on(console: "Console") -> Iterator[None]:
    """Print remarks above what is drawn on a console, not into it."""
    _drawn_on.append(console)
    try:
        yield
    finally:
        _drawn_on.remove(console)


def wrapped(text: str, width: int) -> str:
    """Return text whose lines break between words; a line that is indented is kept to be copied."""
    return "\n".join(
        line
        if len(line) <= width or line.startswith("  ")
        else textwrap.fill(line, width, break_long_words=False, break_on_hyphens=False)
        for line in text.split("\n")
    )


class PeopleHandler(logging.Handler):
    """Prints remarks, on a terminal in lines that it can show.

    Events, which have figures and no sentence, are left out.
    """

    def emit(self, record: logging.LogRecord) -> None:
        """Print a remark."""
        if not hasattr(record, "event"):
            text = printable(hide_passwords(record.getMessage()))
            if not (_drawn_on or sys.stderr.isatty()):
                print(text, file=sys.stderr, flush=True)  # noqa: T201 - a remark
                return
            console = stderr()
            shown = wrapped(text, console.width) if console.is_terminal else text
            console.print(shown, markup=False)


class JsonHandler(logging.Handler):
    """Writes every record as one line of JSON."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        sys.stderr.write(json_line(record) + "\n")
        sys.stderr.flush()


def json_line(record: logging.LogRecord) -> str:
    """Return a record as JSON: time, level, run_id, event, then what is particular to it."""
    content: dict[str, Any] = {
        "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
        "level": record.levelname.lower(),
        "run_id": current_run_id(),
    }
    if hasattr(record, "event"):
        content |= {"event": record.event, **record.__dict__.get("fields", {})}
    else:
        content |= {"event": "message", "message": hide_passwords(record.getMessage())}
    return json.dumps(content, default=str)


def configure_logs(chosen: LogFormat) -> None:
    """Send the program's log to stderr in a format."""
    handler = JsonHandler() if for_machines(chosen) else PeopleHandler()
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False


def for_people() -> bool:
    """Whether a person reads stderr: then progress may be drawn there."""
    return any(isinstance(handler, PeopleHandler) for handler in LOGGER.handlers)
