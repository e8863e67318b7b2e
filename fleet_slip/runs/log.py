"""The history of runs: which commands changed a warehouse, when, and what came of it.

    runs/2026-11.jsonl     one line when a command starts, one when it ends

A line is one write, with a checksum (`fleet_slip.runs.records`), never changed: no lock, and a
killed run lacks its second line. Torn lines are skipped; each record begins a new line. What cannot
be written is not: nothing here fails or delays the command.
"""

import contextlib
import logging
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from fleet_slip.errors import HIDDEN, StorageError, hide_passwords
from fleet_slip.files.folder import Folder
from fleet_slip.runs.records import (
    FOLDER,
    NEWEST_DOCUMENTS,
    newest_documents,
    process_began,
    write_line,
)

LOGGER = logging.getLogger("fleet_slip")
INTERRUPTED = 130
ARGUMENTS_MAX = 50
"""So many arguments are kept; a glob may have given a hundred thousand."""
ERROR_MAX = 2000
"""So many characters of a message are kept."""

_PRIVATE_OPTION = re.compile(
    r"(?i)--?(?:[\w-]*(?:key|token|secret|passw)[\w-]*|vehicle|drive(?:-name)?|source-file)"
)
_NAMES = re.compile(r"(?i)\b(?:vehicle_id|drive_id|drive_name|source_file|trip_id)\b")
_DATA_FILE = re.compile(
    r"(?is).*(\.(?:csv|parquet|mf4|mdf|dat|mat|blf|asc|log|trc|mcap|duckdb|ddb)(?:\.\w+)?)"
)
_ADDRESS = re.compile(r"(--?[\w-]+=)?[^\s:/@=]+:\S*@([^\s@]+)")
"""Of a user with a password, without a scheme."""

_current: ContextVar["Run | None"] = ContextVar("run", default=None)


@dataclass
class MeasuredStep:
    """One step of a run. Whoever does it fills in the figures while it lasts."""

    name: str
    seconds: float = 0.0
    rows: int | None = None
    size_bytes: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the step for the record."""
        return {
            "name": self.name,
            "seconds": round(self.seconds, 6),
            "rows": self.rows,
            "size_bytes": self.size_bytes,
        }


@dataclass
class Run:
    """A command under way."""

    command: str
    arguments: tuple[str, ...]
    started_at: datetime
    run_id: str
    steps: list[MeasuredStep] = field(default_factory=list)

    @classmethod
    def start(cls, command: str, arguments: Sequence[str]) -> "Run":
        """Begin a run now. Its name sorts by time."""
        now = datetime.now(UTC)
        run_id = f"{now:%Y%m%dT%H%M%S.%fZ}-{os.urandom(4).hex()}"
        return cls(command, tuple(arguments), now, run_id)

    @property
    def shown_arguments(self) -> list[str]:
        """The command line without what the history must not keep."""
        kept = publishable(self.arguments)
        more = len(kept) - ARGUMENTS_MAX
        return [*kept[:ARGUMENTS_MAX], f"... and {more} more"] if more > 0 else kept

    def beginning(self) -> dict[str, Any]:
        """Return the line that is written when the run starts."""
        from importlib.metadata import version  # noqa: PLC0415 - what is not recorded needs none

        return {
            "run_id": self.run_id,
            "command": self.command,
            "arguments": self.shown_arguments,
            "started_at": _timestamp(self.started_at),
            "host": os.uname().nodename,
            "process": os.getpid(),
            "process_began": process_began(os.getpid()),
            "package_version": version("fleet-slip"),
        }

    def end(self, error: BaseException | None, seconds: float) -> dict[str, Any]:
        """Return the line that is written when the run ends."""
        exit_code = _exit_code(error)
        told = _without(str(error), self.arguments, publishable(self.arguments))
        told = hide_passwords(told)[:ERROR_MAX]
        outcome = {0: "done", INTERRUPTED: "interrupted"}.get(exit_code, "failed")
        return {
            "run_id": self.run_id,
            "ended_at": _timestamp(datetime.now(UTC)),
            "seconds": round(seconds, 6),
            "outcome": outcome,
            "exit_code": exit_code,
            "error": told if error is not None and exit_code else None,
            "steps": [one.as_dict() for one in self.steps],
        }


def current_run_id() -> str | None:
    """Return the name of the run under way."""
    run = _current.get()
    return run.run_id if run else None


@contextlib.contextmanager
def recording(root: Folder, command: str, arguments: Sequence[str]) -> Iterator[Run]:
    """Record a command that may change a root, only at its end if it made the root itself."""
    run = Run.start(command, arguments)
    file = f"{FOLDER}/{run.started_at:%Y-%m}.jsonl"
    begun = time.monotonic()
    token = _current.set(run)
    told = _exists(root) and _append(root, file, run.beginning())
    log_event("run started", command=command, arguments=run.shown_arguments)
    error: BaseException | None = None
    try:
        yield run
    except BaseException as caught:
        error = caught
        raise
    finally:
        end = run.end(error, time.monotonic() - begun)
        log_event("run ended", **{key: end[key] for key in ("outcome", "exit_code", "seconds")})
        if _exists(root):
            with contextlib.suppress(StorageError):
                end[NEWEST_DOCUMENTS] = newest_documents(root)
            _append(root, file, *([] if told else [run.beginning()]), end)
        _current.reset(token)


@contextlib.contextmanager
def step(name: str) -> Iterator[MeasuredStep]:
    """Time a step of the run under way, and log it. Without a run it is logged only."""
    run = _current.get()
    one = MeasuredStep(name)
    begun = time.monotonic()
    try:
        yield one
    finally:
        one.seconds = time.monotonic() - begun
        if run:
            run.steps.append(one)
        log_event(
            "step ended", step=name, **{k: v for k, v in one.as_dict().items() if k != "name"}
        )


def publishable(arguments: Sequence[str]) -> list[str]:
    """Return command line arguments without what the history must not keep.

    That is keys, tokens, secrets and passwords, users and queries of URLs, and what may name a
    person's car, since the history outlives it: --vehicle, --drive, --drive-name, --source-file,
    conditions on such columns, names of data files.
    """
    kept: list[str] = []
    hide_next = False
    for argument in arguments:
        text = hide_passwords(argument.encode(errors="replace").decode(), whole=True)
        if "://" not in text and (address := _ADDRESS.fullmatch(text)):
            text = f"{address[1] or ''}{HIDDEN}@{address[2]}"
        if _NAMES.search(text):
            text = HIDDEN
        option, equals, _ = text.partition("=")
        private = bool(_PRIVATE_OPTION.fullmatch(option))
        if hide_next:
            text = HIDDEN
        elif private and equals:
            text = f"{option}={HIDDEN}"
        elif data_file := _DATA_FILE.fullmatch(text):
            text = f"{HIDDEN}{data_file[1]}"
        hide_next = private and not equals and not hide_next
        kept.append(text)
    return kept


def _without(text: str, arguments: Sequence[str], shown: Sequence[str]) -> str:
    """Return a message with the arguments that are not shown replaced, wherever it quotes them."""
    for argument, instead in zip(arguments, shown, strict=True):
        if argument != instead:
            secret = argument.partition("=")[2] if instead.endswith(f"={HIDDEN}") else argument
            text = text.replace(secret, HIDDEN) if secret else text
    return text


def _exists(root: Folder) -> bool:
    with contextlib.suppress(StorageError):
        return root.exists()
    return False


def _append(root: Folder, file: str, *records: Mapping[str, Any]) -> bool:
    text = b"".join(b"\n" + write_line(record) + b"\n" for record in records)
    try:
        root.append(file, text)
    except StorageError as error:
        log_event("run not recorded", logging.WARNING, file=f"{root}/{file}", reason=str(error))
        return False
    return True


def log_event(event: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log what happened, with figures: a line for machines, nothing for people."""
    LOGGER.log(level, event, extra={"event": event, "fields": fields})


def _exit_code(error: BaseException | None) -> int:
    if error is None:
        return 0
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    return int(getattr(error, "exit_code", 1))


def _timestamp(moment: datetime) -> str:
    return moment.isoformat(timespec="microseconds")
