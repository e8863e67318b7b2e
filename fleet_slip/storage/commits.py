"""The commits of a table's Delta log, each with a checksum of what it does to the table.

Each note states the SHA-256 of itself and of the actions beside it, however their JSON is written.
It lands with the commit, in any order; `fleet_slip.delta.log_check` compares.
"""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake.transaction import AddAction, RemoveAction

from fleet_slip.base import canonical_json
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder, StoredFile

# Checksums of a table's checkpoints, kept beside its Delta log.
#
# Every hundred commits Delta sums its log up; 30 days later the checkpoint alone tells files and
# units, and nothing guards it. So committers keep a new one's SHA-256 as a document in
# `_checkpoints`, of which the last counts.

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


NOTE = "fleet_slip"

CHECKSUM_KEY = "sha256"

Action = Mapping[str, Any]
"""One action as the log has it: `{"add": {...}}`, `{"remove": {...}}`, `{"txn": {...}}`."""

_CHECKED_KINDS = frozenset({"add", "remove", "txn"})
_KINDS = _CHECKED_KINDS | {"commitInfo", "metaData", "protocol"}


def checked_note(
    note: Mapping[str, Any],
    actions: Sequence[AddAction | RemoveAction],
    units: Mapping[str, int],
) -> str:
    """Return a commit's note as text, with the checksum of itself, its actions and its units."""
    stated = [_added(a) if isinstance(a, AddAction) else _removed(a) for a in actions]
    stated += [{"txn": {"appId": name, "version": number}} for name, number in units.items()]
    return json.dumps({**note, CHECKSUM_KEY: checksum_of_actions(note, stated)})


def checksum_of_actions(note: Mapping[str, Any], actions: Sequence[Action]) -> str:
    """Return the checksum of a note and of actions as the log has them, in any order."""
    rest = {key: value for key, value in note.items() if key != CHECKSUM_KEY}
    texts = [canonical_json({k: _stated(k, v) for k, v in action.items()}) for action in actions]
    text = "\n".join([canonical_json(rest), *sorted(texts)])
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _added(action: AddAction) -> Action:
    return {
        "add": {
            "path": action.path,
            "partitionValues": action.partition_values,
            "size": action.size,
            "modificationTime": action.modification_time,
            "dataChange": action.data_change,
            "stats": action.stats,
        }
    }


def _removed(action: RemoveAction) -> Action:
    return {
        "remove": {
            "path": action.path,
            "partitionValues": action.partition_values,
            "size": action.size,
            "deletionTimestamp": action.deletion_timestamp,
            "dataChange": action.data_change,
        }
    }


def _stated(kind: str, content: Any) -> Any:
    """Return what an action states, without what the Delta library adds to it."""
    if not isinstance(content, Mapping):
        return content
    added = {"extendedFileMetadata"} if kind == "remove" else set()
    return {k: v for k, v in content.items() if v is not None and k not in added}


@dataclass(frozen=True)
class Commit:
    """One commit: the name of its file, and its actions."""

    name: str
    actions: Sequence[Action]

    @property
    def info(self) -> Mapping[str, Any]:
        """What the Delta library says of it."""
        return next((action["commitInfo"] for action in self.actions if "commitInfo" in action), {})

    @property
    def note(self) -> Mapping[str, Any]:
        """What this program says of it."""
        return _object(self.info.get(NOTE, "{}"))

    @property
    def checked_actions(self) -> list[Action]:
        """The actions that the commit's checksum is of; overwriting, Delta removes by itself."""
        overwriting = _parameters(self).get("mode") == "Overwrite"
        kinds = _CHECKED_KINDS - {"remove"} if overwriting else _CHECKED_KINDS
        return [action for action in self.actions if kinds & action.keys()]


def read_commit(log: Folder, name: str) -> Commit:
    """Return a commit of a Delta log. Raises `ValueError` for what is none."""
    try:
        text = log.read(name).decode()
        actions = [json.loads(line) for line in text.split("\n") if line]
    except StorageError as error:
        raise ValueError(f"cannot be read: {error}") from None
    except (ValueError, RecursionError):
        raise ValueError("is not JSON") from None
    for action in actions:
        if not isinstance(action, dict) or len(action) != 1 or not action.keys() <= _KINDS:
            raise ValueError("has an action that this program never writes")
        if not all(isinstance(content, dict) for content in action.values()):
            raise ValueError("has an action without content")
    return Commit(name, actions)


def problem_of_commit(commit: Commit, must_state_checksum: bool) -> str | None:
    """Return what is wrong with a commit, or None."""
    stated = commit.note.get(CHECKSUM_KEY)
    if stated is not None and not _matches_checksum(commit, stated):
        return "its content does not match the checksum that it states"
    if stated is None and must_state_checksum and commit.checked_actions:
        return "states no checksum, although earlier commits do: damage, or another program's"
    if version_of(commit.name) == 0 and not _made_as_stated(commit):
        return "states in two ways what the table is"
    return None


def _matches_checksum(commit: Commit, stated: Any) -> bool:
    try:
        return bool(stated == checksum_of_actions(commit.note, commit.checked_actions))
    except ValueError:  # a number that is none, which only damage puts there
        return False


def _made_as_stated(commit: Commit) -> bool:
    """Whether the commit that made the table says what it is, twice the same."""
    stated = _parameters(commit)
    made = {kind: content for action in commit.actions for kind, content in action.items()}
    return all(
        made.get(kind) == _object(stated.get(key))
        for kind, key in (("metaData", "metadata"), ("protocol", "protocol"))
    )


def _parameters(commit: Commit) -> Mapping[str, Any]:
    found = commit.info.get("operationParameters")
    return found if isinstance(found, Mapping) else {}


def _object(text: Any) -> Mapping[str, Any]:
    """Return a JSON object from its text; an empty one if it is none."""
    try:
        found = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def read_landed_units(table: Folder, version: int) -> dict[str, int]:
    """Return the numbers of all units that have landed in a version. Raises `StorageError`."""
    log = table / LOG
    files = log.files()
    numbers: dict[str, int] = {}
    checkpoint = newest_checkpoint(files, version)
    after = version_of(checkpoint.name) if checkpoint else -1
    for file in files:  # a checkpoint may be of several
        if checkpoint and file.name.startswith(f"{after:020}.checkpoint."):
            with pq.ParquetFile(pa.BufferReader(log.read(file.name))) as parquet:
                columns = ["txn.appId", "txn.version"]
                told = parquet.read(columns=columns)["txn"].combine_chunks().drop_null()
            each = (told.field(name).to_pylist() for name in ("appId", "version"))
            numbers.update((n, number) for n, number in zip(*each, strict=True) if n is not None)
    for file in files:
        if COMMIT_FILE.fullmatch(file.name) and after < version_of(file.name) <= version:
            try:
                commit = read_commit(log, file.name)
            except ValueError as error:
                raise StorageError(f"{file}: {error}") from None
            stated = (action["txn"] for action in commit.actions if "txn" in action)
            numbers.update((one["appId"], one["version"]) for one in stated)
    return numbers
