"""How the tables `logs` and `grams` differ."""

from collections.abc import Collection
from dataclasses import dataclass

import pyarrow.compute as pc

from fleet_slip.catalogue.facts import RECEIVED_FILES
from fleet_slip.catalogue.features import PLAIN
from fleet_slip.errors import ConflictError
from fleet_slip.grams.gram_files import is_of_received
from fleet_slip.storage.table import Snapshot, TableFile

BEING_WRITTEN_HOURS = 1.0
"""A file that no commit ever knew and that is younger may belong to a job that is running."""


@dataclass(frozen=True)
class Backlog:
    """How `grams` and `logs` differ."""

    missing: tuple[TableFile, ...]
    stale: frozenset[str]
    """Paths in `grams`, of any set, that are no active log file, and none that may become one."""


def find_backlog(logs: Snapshot, grams: Snapshot, identity: str = PLAIN) -> Backlog:
    """Compare active log files with those that Gram rows of a feature set's `identity` name."""
    done, named = named_files(grams, identity)
    active = {file.path for file in logs.files}
    return Backlog(
        missing=tuple(file for file in logs.files if file.path not in done),
        stale=frozenset(named - active - _about_to_land(logs, named - active)),
    )


def named_files(grams: Snapshot, identity: str) -> tuple[set[str], set[str]]:
    """Return the log files that Gram rows of a feature set name, and those that any name."""
    done: set[str] = set()
    named: set[str] = set()
    for file in grams.files:
        if is_of_received(file):  # of no log
            continue
        pairs = grams.table.read_combinations(file.path, ["feature_set", "file"])
        named.update(name for name in pairs["file"].to_pylist() if _has_log(name))
        done.update(pairs["file"].filter(pc.equal(pairs["feature_set"], identity)).to_pylist())
    return done, named


def _has_log(file: str) -> bool:
    """Whether a Gram row is of a log file, rather than sent by a car."""
    return not file.startswith(RECEIVED_FILES)


def _about_to_land(logs: Snapshot, paths: Collection[str]) -> set[str]:
    """Return the log files that a job has written and not committed: their Gram rows land first."""
    if not paths:
        return set()
    written = {
        file.path
        for file in logs.table.folder.files()
        if file.path in paths and file.age_hours < BEING_WRITTEN_HOURS
    }
    return written - logs.removed() if written else set()


def require_active(logs: Snapshot, files: Collection[TableFile]) -> None:
    """Raise `ConflictError` if the logs have lost a file whose Gram rows are landing."""
    lost = {file.path for file in files} - {file.path for file in logs.files}
    if lost:
        raise ConflictError(
            f"{logs.table.folder}: other processes keep removing files, such as {min(lost)}. Run "
            "the same command again."
        )
