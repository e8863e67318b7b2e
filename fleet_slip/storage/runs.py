"""The history of runs: the commands that changed a data root, and their outcomes.

    runs/2026-11.jsonl                        one line when a command starts, one when it ends
    runs/2026-11.jsonl/TIME-RANDOM.jsonl      such lines, on an object store

A line is one write, never changed, that ends in a checksum of the bytes before: no lock, and a
killed run lacks its second line. A line without a valid checksum was changed, or torn by a full
disk or a power cut.
"""

import contextlib
import hashlib
import json
import logging
import os
import re
import socket
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fleet_slip.errors import HIDDEN, INTERRUPTED, StorageError, hide_passwords
from fleet_slip.resources import read_sql
from fleet_slip.storage.folder import Folder

if TYPE_CHECKING:
    import duckdb

PROC = Path("/proc")
START = 19
"""Index of the start time after the name in /proc/PID/stat, proc(5): ticks since boot."""

FOLDER = "runs"

_DIGITS = 32
_WITH_CHECKSUM = re.compile(rb'(.*),"sha256":"([0-9a-f]{%d})"\}' % _DIGITS)


def process_began(number: int) -> str | None:
    """Return boot and start of a process, as numbers are reused; None if it does not exist."""
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        status = (PROC / str(number) / "stat").read_bytes()
    except OSError:
        return None
    return f"{boot}/{status.rpartition(b')')[2].split()[START].decode()}"


def write_line(record: Mapping[str, Any]) -> bytes:
    """Return a record as a line with its checksum, without the end of the line."""
    body = json.dumps(record, separators=(",", ":")).encode().removesuffix(b"}")
    return body + b',"sha256":"' + _checksum(body) + b'"}'


def read_lines(content: bytes) -> tuple[list[bytes], list[int]]:
    """Return the intact lines, and the numbers of damaged lines, from 1."""
    intact, damaged = [], []
    for number, line in enumerate(content.split(b"\n"), 1):
        match = _WITH_CHECKSUM.fullmatch(line)
        if match and _checksum(match[1]) == match[2]:
            intact.append(line)
        elif line:
            damaged.append(number)
    return intact, damaged


def find_changed_lines(root: Folder, since: str = "") -> Iterator[tuple[str, str]]:
    """Yield files with damaged lines, from a month YYYY-MM on, and a text on each line."""
    for path, content in _read_history(root, since):
        for number in read_lines(content)[1]:
            yield f"{FOLDER}/{path}", f"line {number} was changed or torn"


def _read_history(root: Folder, since: str = "") -> list[tuple[str, bytes]]:
    """Return the files of the history from a month YYYY-MM on. Raises `StorageError`."""
    folder = root / FOLDER
    paths = [f.path for f in folder.files() if f.path.endswith(".jsonl") and f.path >= since]
    contents = folder.read_many(paths)
    return [(path, content or b"") for path, content in zip(paths, contents, strict=True)]


def _checksum(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest()[:_DIGITS].encode()


LOGGER = logging.getLogger("fleet_slip")
ARGUMENTS_MAX = 50
"""Maximum number of recorded arguments; a glob can give a hundred thousand."""
ERROR_MAX = 2000
"""Maximum number of recorded characters of a message."""

_PRIVATE_OPTION = re.compile(r"(?i)--?(?:[\w-]*(?:key|token|secret|passw)[\w-]*|vehicle|drive)")
_NAMES = re.compile(r"(?i)\b(?:vehicle_id|drive_id|drive_name|source_file|trip_id)\b")
_DATA_FILE = re.compile(
    r"(?is).*(\.(?:csv|parquet|pq|mf4|mdf|dat|mat|h5|hdf5|blf|asc|log|trc|mcap|duckdb|ddb|tdms|vbo)"
    r"(?:\.\w+)?)"
)
_ADDRESS = re.compile(r"(--?[\w-]+=)?[^\s:/@=]+:\S*@([^\s@]+)")
"""A user with a password at a host, without a scheme."""

_current: ContextVar["Run | None"] = ContextVar("run", default=None)


@dataclass
class MeasuredStep:
    """One step of a run; the code of the step sets `rows` and `size_bytes`."""

    name: str
    seconds: float = 0.0
    rows: int | None = None
    size_bytes: int | None = None


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

    def beginning(self) -> dict[str, Any]:
        """Return the line that is written when the run starts."""
        from importlib.metadata import version

        return {
            "run_id": self.run_id,
            "command": self.command,
            "arguments": publishable(self.arguments)[:ARGUMENTS_MAX],
            "started_at": _timestamp(self.started_at),
            "host": os.uname().nodename,
            "process": os.getpid(),
            "process_began": process_began(os.getpid()),
            "package_version": version("fleet-slip"),
        }

    def end(self, error: BaseException | None, seconds: float) -> dict[str, Any]:
        """Return the line that is written when the run ends."""
        exit_code = 0 if error is None else int(getattr(error, "exit_code", 1))
        if isinstance(error, KeyboardInterrupt):
            exit_code = INTERRUPTED
        message = _without_hidden(hide_passwords(str(error)), self.arguments)[:ERROR_MAX]
        outcome = {0: "done", INTERRUPTED: "interrupted"}.get(exit_code, "failed")
        return {
            "run_id": self.run_id,
            "ended_at": _timestamp(datetime.now(UTC)),
            "seconds": round(seconds, 6),
            "outcome": outcome,
            "exit_code": exit_code,
            "error": message if error is not None and exit_code else None,
            "steps": [asdict(step) for step in self.steps],
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
    is_recorded = _append(root, file, run.beginning())
    error: BaseException | None = None
    try:
        yield run
    except BaseException as caught:
        error = caught
        raise
    finally:
        beginning = [] if is_recorded else [run.beginning()]
        end = run.end(error, time.monotonic() - begun)
        if _append(root, file, *beginning, end) is False:
            LOGGER.warning(
                "%s: the run history cannot be written; this run is missing in it.", root
            )
        _current.reset(token)


@contextlib.contextmanager
def step(name: str) -> Iterator[MeasuredStep]:
    """Time a step of the run under way, if there is one."""
    run = _current.get()
    measured = MeasuredStep(name)
    begun = time.monotonic()
    try:
        yield measured
    finally:
        measured.seconds = round(time.monotonic() - begun, 6)
        if run:
            run.steps.append(measured)


@contextlib.contextmanager
def recorded_step(root: Folder, name: str, arguments: Sequence[str]) -> Iterator[MeasuredStep]:
    """Time a step of the run under way; without one, record the step as a run of its own."""
    run = contextlib.nullcontext() if _current.get() else recording(root, name, arguments)
    with run, step(name) as measured:
        yield measured


def publishable(arguments: Sequence[str]) -> list[str]:
    """Return command line arguments without private parts.

    Private are keys, tokens, secrets, passwords, users and queries of URLs. So is what may name a
    person's car, as an erasure keeps the history: --vehicle, --drive, predicates on such columns,
    names of data files.
    """
    public: list[str] = []
    hide_next = False
    for argument in arguments:
        text = hide_passwords(argument.encode(errors="replace").decode(), to_end=True)
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
        public.append(text)
    return public


def _without_hidden(text: str, arguments: Sequence[str]) -> str:
    """Return a message in which hidden arguments, or hidden values of options, are replaced."""
    for argument, shown in zip(arguments, publishable(arguments), strict=True):
        hidden, instead = argument, shown
        if shown.endswith(f"={HIDDEN}"):
            hidden, instead = argument.partition("=")[2], HIDDEN
        if argument != shown and hidden:
            text = text.replace(hidden, instead)
    return text


def _append(root: Folder, file: str, *records: Mapping[str, Any]) -> bool | None:
    """Append records to a file; return False on failure, None if the root does not exist."""
    text = b"".join(b"\n" + write_line(record) + b"\n" for record in records)
    try:
        if not root.exists():
            return None
        root.append(file, text)
    except StorageError:
        return False
    return True


def _timestamp(moment: datetime) -> str:
    return moment.isoformat(timespec="microseconds")


RUNNING = "running"
KILLED = "killed"


def add_runs(database: "duckdb.DuckDBPyConnection", root: Folder, since: str = "") -> None:
    """Make the table `runs` of a connection, since a month YYYY-MM; see `warehouse/runs.sql`.

    Raises `StorageError` for a changed line.
    """
    import pyarrow as pa

    chunks = []
    for path, content in _read_history(root, since):
        lines, changed = read_lines(content)
        if changed:
            raise StorageError(
                f"{root}/{FOLDER}/{path}: line {changed[0]} was changed or torn. Restore the "
                "file from a backup, or delete the line: no other depends on it."
            )
        chunks.append(pa.array(lines, pa.binary()).cast(pa.string()))
    rows = pa.chunked_array(chunks, pa.string())
    database.register("run_lines", pa.table({"line": rows}))
    database.execute(read_sql("warehouse", "runs.sql"))
    database.unregister("run_lines")


def runs_under_way(root: Folder) -> list[str]:
    """Return other runs without an end: live ones of this machine, and of others for a day."""
    host = socket.gethostname()
    since = datetime.now(UTC) - timedelta(days=1)
    begun: dict[str, dict[str, Any]] = defaultdict(dict)
    for _, content in _read_history(root, f"{since:%Y-%m}"):
        for record in map(json.loads, read_lines(content)[0]):
            begun[record["run_id"]].update(record)
    return [
        run_id
        for run_id, run in sorted(begun.items())
        if run_id != current_run_id()
        and (run.get("host") == host or f"{run_id:.16}" >= f"{since:%Y%m%dT%H%M%S}")
        and state_of({"outcome": None, "host": None, "process": None, **run}) == RUNNING
    ]


def state_of(run: Mapping[str, Any]) -> str:
    """Return done, failed, interrupted, running, or killed: no outcome, and its process is gone.

    Another machine's process counts as running; a reused number differs in its beginning.
    """
    if run["outcome"] is not None:
        return str(run["outcome"])
    if run["host"] != socket.gethostname():
        return RUNNING
    try:
        os.kill(run["process"], 0)
    except ProcessLookupError:
        return KILLED
    except (PermissionError, TypeError):
        pass  # another user's, or a record without a number
    began = run.get("process_began")
    now = process_began(run["process"]) if began is not None else None
    return RUNNING if now is None or now == began else KILLED
