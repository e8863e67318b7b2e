"""The commits of a table's Delta log, each with a checksum of what it does to the table.

Each note states the SHA-256 of itself and of the actions beside it, however their JSON is written.
It lands with the commit, in any order; `fleet_slip.delta.log_check` compares.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake.transaction import AddAction, RemoveAction

from fleet_slip.canonical import canonical_json
from fleet_slip.delta.checkpoints import COMMIT_FILE, LOG, newest_checkpoint, version_of
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder

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
