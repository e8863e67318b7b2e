"""Checksums of a table's checkpoints, kept beside its Delta log.

Every hundred commits Delta sums its log up; 30 days later the checkpoint alone tells files and
units, and nothing guards it. So committers keep a new one's SHA-256 as a document in
`_checkpoints`, of which the last counts.
"""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterable, Iterator

from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder, StoredFile

FOLDER = "_checkpoints"
"""Folder of the documents below a table; other programs take such names for hidden."""

LOG = "_delta_log"
LATEST = "_last_checkpoint"

_CHECKPOINT = re.compile(r"(\d{20})\.checkpoint.*\.parquet")
COMMIT_FILE = re.compile(r"\d{20}\.json")


def keep_checksum_of_new(table: Folder, before: int | None) -> None:
    """Keep checksums of checkpoints that came since version `before`, if possible by now."""
    latest = None
    with contextlib.suppress(StorageError, ValueError, KeyError, TypeError, RecursionError):
        latest = int(json.loads((table / LOG).read(LATEST))["version"])
    if latest is not None and (before is None or latest > before):
        with contextlib.suppress(StorageError, ConflictError):
            keep_checksums(table)


def keep_checksums(table: Folder, *, again: str | None = None) -> None:
    """Keep the checksums of all checkpoints that have none, and of the one written `again`."""
    documents = DocumentFolder(table / FOLDER)
    known = kept_checksums(table)
    for name in _checkpoints(table):
        if name not in known or name == again:
            documents.append({"checkpoint": name, "sha256": _digest(table, name)})


def kept_checksums(table: Folder) -> dict[str, str]:
    """Return the checksums that are kept, by checkpoint. Raises `StorageError` if damaged."""
    documents = DocumentFolder(table / FOLDER)
    kept = (documents.read(number).content for number in documents.numbers())
    return {str(one["checkpoint"]): str(one["sha256"]) for one in kept}


def checkpoint_faults(table: Folder) -> Iterator[tuple[str, str]]:
    """Yield the damaged checkpoints of a table, in the order of their versions, and the problem."""
    known = kept_checksums(table)
    for name in _checkpoints(table):
        try:
            if name in known and _digest(table, name) != known[name]:
                yield (name, "its bytes do not match the checksum kept of it")
        except StorageError as error:
            yield (name, f"cannot be read: {error}")


def newest_checkpoint(files: Iterable[StoredFile], version: int) -> StoredFile | None:
    """Return the newest checkpoint of a log that a version is told from; None without one."""
    found = [f for f in files if _CHECKPOINT.fullmatch(f.name) and version_of(f.name) <= version]
    return max(found, key=lambda file: file.name, default=None)


def require_kept_checksum(table: Folder, name: str) -> None:
    """Raise `StorageError` for a checkpoint that is not what its checksum tells, if one is kept."""
    expected = kept_checksums(table).get(name)
    if expected is not None and _digest(table, name) != expected:
        raise StorageError(
            f"{table}/{LOG}/{name}: its bytes do not match the checksum kept of it: it was "
            "damaged. See what can be repaired with: fleet-slip verify --repair"
        )


def checkpoints_without_checksum(table: Folder) -> list[str]:
    """Return the checkpoints of which no checksum is kept."""
    known = kept_checksums(table)
    return [name for name in _checkpoints(table) if name not in known]


def list_dispensable(table: Folder, damaged: str) -> bool:
    """Whether a table can be read without a checkpoint: from an earlier one, or from its start."""
    names = (table / LOG).names()
    commits = {version_of(name) for name in names if COMMIT_FILE.fullmatch(name)}
    faulty = {name for name, _ in checkpoint_faults(table)} | {damaged}
    sound = {version_of(name) for name in _checkpoints(table) if name not in faulty}
    base = max((version for version in sound if version < version_of(damaged)), default=-1)
    return bool(commits) and commits >= set(range(base + 1, max(commits) + 1))


def remove_checkpoint(table: Folder, name: str) -> None:
    """Remove a checkpoint that is `list_dispensable`, and the note that may name it."""
    for file in (table / LOG).files():
        if file.name in (name, LATEST):
            file.folder.remove(file)


def _checkpoints(table: Folder) -> list[str]:
    return [name for name in (table / LOG).names() if _CHECKPOINT.fullmatch(name)]


def version_of(name: str) -> int:
    """Return the version that the file of a commit, or a checkpoint, makes or sums up."""
    return int(name.partition(".")[0])


def _digest(table: Folder, name: str) -> str:
    return hashlib.sha256((table / LOG).read(name)).hexdigest()
