"""Reading the history of runs, and keeping it short where every record is an object of its own.

    runs/2026-11.jsonl                        the records of a month, in a folder
    runs/2026-11.jsonl/TIME-RANDOM.jsonl      a record, on an object store
    runs/2026-11.jsonl/CHECKSUM.jsonl         records of that month, gathered

Gathering takes no lock: a record is deleted by who has written an object that has it, so that each
is there once or more; the view `runs` counts by name, and readers list again.
"""

import hashlib
import json
import os
import socket
from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import duckdb

from fleet_slip.files.folder import Folder, StoredFile
from fleet_slip.resources import read_sql
from fleet_slip.runs.log import current_run_id
from fleet_slip.runs.records import (
    FOLDER,
    RECORD_COLUMNS,
    is_intact,
    process_began,
    require_unchanged,
)

REMOVALS_AT_ONCE = 16
RUNNING = "running"
KILLED = "killed"


def lend_runs(root: Folder, database: duckdb.DuckDBPyConnection, since: str = "") -> list[str]:
    """Let a connection read the history since a month; return its URIs. Raises `StorageError`."""
    require_unchanged(root, since)
    return (root / FOLDER).lend(database, lambda path: _is_record(path) and path >= since)


def runs_under_way(root: Folder) -> list[str]:
    """Return other runs of the last day that have no end, but for dead ones of this machine."""
    since = datetime.now(UTC) - timedelta(days=1)
    begun: dict[str, Mapping[str, Any]] = {}
    folder = root / FOLDER
    paths = [f.path for f in folder.files() if _is_record(f.path) and f.path >= f"{since:%Y-%m}"]
    for content in folder.read_many(paths):
        for line in (content or b"").splitlines():
            if is_intact(line):
                record = json.loads(line)
                begun[record["run_id"]] = {**begun.get(record["run_id"], {}), **record}
    return [
        run_id
        for run_id, run in sorted(begun.items())
        if run_id != current_run_id()
        and f"{run_id:.16}" >= f"{since:%Y%m%dT%H%M%S}"
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


def gather_runs(root: Folder) -> int:
    """Gather the records of each month in one object, on a store; return how many there were."""
    folder = root / FOLDER
    months: dict[str, list[StoredFile]] = defaultdict(list)
    for file in folder.files():
        month, _, name = file.path.partition("/")
        if name and _is_record(name):
            months[month].append(file)
    scattered = {month: files for month, files in months.items() if len(files) > 1}
    for month, files in scattered.items():
        _gather(folder, month, files)
    return sum(len(files) for files in scattered.values())


def _gather(folder: Folder, month: str, files: list[StoredFile]) -> None:
    contents = folder.read_many([file.path for file in files])
    read = {file: content for file, content in zip(files, contents, strict=True) if content}
    # Sorted and each once: the same records are the same object, whoever gathers them.
    lines = sorted({line for content in read.values() for line in content.splitlines() if line})
    whole = b"".join(line + b"\n" for line in lines)
    target = f"{month}/{hashlib.sha256(whole).hexdigest()[:32]}.jsonl"
    folder.create(target, whole)
    with ThreadPoolExecutor(REMOVALS_AT_ONCE) as executor:
        list(executor.map(folder.remove, (file for file in read if file.path != target)))


def _is_record(path: str) -> bool:
    return path.endswith(".jsonl")


def run_source(database: duckdb.DuckDBPyConnection, files: list[str]) -> str:
    """Return what stands after FROM for the history of runs, or some of its files."""
    columns = ", ".join(f"{name} {kind}" for name, kind in RECORD_COLUMNS.items())
    database.execute("SET VARIABLE run_files = $paths", {"paths": files})
    if files:
        return read_sql("warehouse", "stored_runs.sql").format(run_columns=RECORD_COLUMNS)
    database.execute(f"CREATE TABLE empty_runs ({columns})")
    return "empty_runs"
