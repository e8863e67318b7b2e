"""Checksums of a table's checkpoints, kept beside its Delta log.

Every hundred commits the Delta library sums the log up in a checkpoint, and after 30 days it
removes the commits before that. Then the checkpoint alone tells which files and units of work there
are, and nothing in it is guarded. So whoever commits looks whether a checkpoint has come since, and
keeps the SHA-256 of its bytes as a document in `_checkpoints` below the table. Of documents about
the same checkpoint the last counts.
"""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder, StoredFile

FOLDER = "_checkpoints"
"""Folder of the documents below a table; other programs take such names for hidden."""

LOG = "_delta_log"
LATEST = "_last_checkpoint"

_CHECKPOINT = re.compile(r"(\d{20})\.checkpoint.*\.parquet")
_COMMIT = re.compile(r"(\d{20})\.json")


@dataclass(frozen=True)
class CheckpointFault:
    """A checkpoint whose bytes are not those that were written."""

    name: str
    problem: str


def seal_new_checkpoint(table: Folder, before: int | None) -> None:
    """Keep the checksums of the checkpoints of a table if one has come since version `before`.

    Also those of earlier ones that a killed job has left without. The commit has landed: what
    cannot be kept now is kept with the next checkpoint.
    """
    latest = _latest(table)
    if latest is not None and (before is None or latest > before):
        with contextlib.suppress(StorageError, ConflictError):
            seal_checkpoints(table)


def seal_checkpoints(table: Folder, *, again: str | None = None) -> None:
    """Keep the checksums of all checkpoints that have none, and of the one written `again`."""
    documents = DocumentFolder(table / FOLDER)
    known = sealed_checkpoints(table)
    for name in _checkpoints(table):
        if name not in known or name == again:
            documents.append({"checkpoint": name, "sha256": _digest(table, name)})


def sealed_checkpoints(table: Folder) -> dict[str, str]:
    """Return the checksums that are kept, by checkpoint. Raises `StorageError` if damaged."""
    documents = DocumentFolder(table / FOLDER)
    kept = (documents.read(number).content for number in documents.numbers())
    return {str(one["checkpoint"]): str(one["sha256"]) for one in kept}


def checkpoint_faults(table: Folder) -> Iterator[CheckpointFault]:
    """Yield the checkpoints of a table that were damaged, in the order of their versions."""
    known = sealed_checkpoints(table)
    for name in _checkpoints(table):
        try:
            if name in known and _digest(table, name) != known[name]:
                yield CheckpointFault(name, "its bytes do not match the checksum kept of it")
        except StorageError as error:
            yield CheckpointFault(name, f"cannot be read: {error}")


def newest_checkpoint(files: Iterable[StoredFile], version: int) -> StoredFile | None:
    """Return the newest checkpoint of a log that a version is told from; None without one."""
    found = [f for f in files if _CHECKPOINT.fullmatch(f.name) and _version(f.name) <= version]
    return max(found, key=lambda file: file.name, default=None)


def require_sealed(table: Folder, name: str) -> None:
    """Raise `StorageError` for a checkpoint that is not what its checksum tells, if one is kept."""
    expected = sealed_checkpoints(table).get(name)
    if expected is not None and _digest(table, name) != expected:
        raise StorageError(
            f"{table}/{LOG}/{name}: its bytes do not match the checksum kept of it: it was "
            "damaged. See what can be repaired with: fleet-slip verify --repair"
        )


def unsealed_checkpoints(table: Folder) -> list[str]:
    """Return the checkpoints of which no checksum is kept."""
    known = sealed_checkpoints(table)
    return [name for name in _checkpoints(table) if name not in known]


def list_dispensable(table: Folder, damaged: str) -> bool:
    """Whether a table can be read without a checkpoint: from an earlier one, or from its start."""
    names = (table / LOG).names()
    commits = {int(found[1]) for found in map(_COMMIT.fullmatch, names) if found}
    faulty = {fault.name for fault in checkpoint_faults(table)} | {damaged}
    sound = {_version(name) for name in _checkpoints(table) if name not in faulty}
    base = max((version for version in sound if version < _version(damaged)), default=-1)
    return bool(commits) and commits >= set(range(base + 1, max(commits) + 1))


def remove_checkpoint(table: Folder, name: str) -> None:
    """Remove a checkpoint that is `list_dispensable`, and the note that may name it."""
    for file in _log_files(table):
        if file.name in (name, LATEST):
            file.folder.remove(file)


def _log_files(table: Folder) -> list[StoredFile]:
    return (table / LOG).files()


def _checkpoints(table: Folder) -> list[str]:
    return [name for name in (table / LOG).names() if _CHECKPOINT.fullmatch(name)]


def _version(name: str) -> int:
    return int(name.partition(".")[0])


def _digest(table: Folder, name: str) -> str:
    return hashlib.sha256((table / LOG).read(name)).hexdigest()


def _latest(table: Folder) -> int | None:
    """Return the version of the newest checkpoint, as the Delta library notes it."""
    with contextlib.suppress(StorageError, ValueError, KeyError, TypeError, RecursionError):
        return int(json.loads((table / LOG).read(LATEST))["version"])
    return None
