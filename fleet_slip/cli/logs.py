"""Remarks and events on stderr: text for people, or one JSON object a line for machines."""

import json
import logging
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from typing import TYPE_CHECKING

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


class JsonFormatter(logging.Formatter):
    """Makes a record a line of JSON: time, level, run_id, event, and what is particular to it."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        known = {"event": getattr(record, "event", "message"), **getattr(record, "fields", {})}
        if known["event"] == "message":
            known["message"] = hide_passwords(record.getMessage())
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        level = record.levelname.lower()
        head = {"time": time, "level": level, "run_id": current_run_id()}
        return json.dumps(head | known, default=str)


def configure_logs(chosen: LogFormat) -> None:
    """Send the program's log to stderr in a format."""
    handler: logging.Handler = PeopleHandler()
    if for_machines(chosen):
        handler = logging.StreamHandler()
        handler.setFormatter(JsonFormatter())
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False


def for_people() -> bool:
    """Whether a person reads stderr: then progress may be drawn there."""
    return any(isinstance(handler, PeopleHandler) for handler in LOGGER.handlers)
