"""The commits of a table's Delta log, each with a checksum of its actions.

Each note states the SHA-256 of itself and of the actions beside it, however their JSON is written.
It lands with the commit, in any order; `verify` compares.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fleet_slip.base import canonical_json
from fleet_slip.errors import StorageError
from fleet_slip.storage.folder import Folder

if TYPE_CHECKING:
    from deltalake.transaction import AddAction, RemoveAction

    from fleet_slip.storage.table import Snapshot

LOG = "_delta_log"
LATEST = "_last_checkpoint"
NOTE = "fleet_slip"
CHECKSUM_KEY = "sha256"

Action = Mapping[str, Any]
"""One action of the log: `{"add": {...}}`, `{"remove": {...}}`, `{"txn": {...}}`."""

_CHECKPOINT = re.compile(r"(\d{20})\.checkpoint.*\.parquet")
_COMMIT = re.compile(r"\d{20}\.json")
_CHECKED_KINDS = frozenset({"add", "remove", "txn"})
_KINDS = _CHECKED_KINDS | {"commitInfo", "metaData", "protocol"}


def checked_note(
    note: Mapping[str, Any],
    actions: "Sequence[AddAction | RemoveAction]",
    transactions: Mapping[str, int],
) -> str:
    """Return a note as text, with the checksum of note, actions and transactions."""
    stated = [*map(_as_logged, actions)]
    stated += [{"txn": {"appId": name, "version": number}} for name, number in transactions.items()]
    return json.dumps({**note, CHECKSUM_KEY: checksum_of_actions(note, stated)})


def checksum_of_actions(note: Mapping[str, Any], actions: Sequence[Action]) -> str:
    """Return the checksum of a note and of actions of the log, in any order."""
    unchecked = {key: value for key, value in note.items() if key != CHECKSUM_KEY}
    texts = [canonical_json({k: _stated(k, v) for k, v in action.items()}) for action in actions]
    text = "\n".join([canonical_json(unchecked), *sorted(texts)])
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


_FIELDS = {
    "add": ("path", "partition_values", "size", "modification_time", "data_change", "stats"),
    "remove": ("path", "partition_values", "size", "deletion_timestamp", "data_change"),
}
"""Fields in the log of each kind of action, there in camel case."""


def _as_logged(action: "AddAction | RemoveAction") -> Action:
    from deltalake.transaction import AddAction

    kind = "add" if isinstance(action, AddAction) else "remove"
    return {
        kind: {
            re.sub(r"_(\w)", lambda match: match[1].upper(), name): getattr(action, name)
            for name in _FIELDS[kind]
        }
    }


def _stated(kind: str, content: Any) -> Any:
    """Return an action without the fields that the Delta library adds."""
    if not isinstance(content, Mapping):
        return content
    added = {"extendedFileMetadata"} if kind == "remove" else set()
    return {k: v for k, v in content.items() if v is not None and k not in added}


@dataclass(frozen=True)
class Commit:
    """One commit: its version, and its actions."""

    version: int
    actions: Sequence[Action]

    @property
    def info(self) -> Mapping[str, Any]:
        """The commit info of the Delta library."""
        return next((action["commitInfo"] for action in self.actions if "commitInfo" in action), {})

    @property
    def note(self) -> Mapping[str, Any]:
        """The note of this program."""
        return _object(self.info.get(NOTE, "{}"))

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The operation parameters of the Delta library."""
        parameters = self.info.get("operationParameters")
        return parameters if isinstance(parameters, Mapping) else {}

    def problem(self) -> str | None:
        """Return the problem of the commit; None without one."""
        # Overwriting, Delta removes files by itself.
        unchecked = {"remove"} if self.parameters.get("mode") == "Overwrite" else set()
        checked = [a for a in self.actions if (_CHECKED_KINDS - unchecked) & a.keys()]
        stated = self.note.get(CHECKSUM_KEY)
        if stated is not None and not _has_checksum(self.note, checked, stated):
            return "its content does not match the checksum that it states"
        if stated is None and checked:
            return "states no checksum: damage, or another program's"
        contents = {kind: content for action in self.actions for kind, content in action.items()}
        for kind, key in (("metaData", "metadata"), ("protocol", "protocol")):
            if self.version == 0 and contents.get(kind) != _object(self.parameters.get(key)):
                return "defines the table twice, differently"
        return None


def _has_checksum(note: Mapping[str, Any], actions: Sequence[Action], stated: Any) -> bool:
    try:
        return bool(stated == checksum_of_actions(note, actions))
    except ValueError:  # a number that is none, which only damage puts there
        return False


def _object(text: Any) -> Mapping[str, Any]:
    """Parse a JSON object; return an empty one for any other text."""
    try:
        value = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _actions_in(text: bytes | None) -> list[Action]:
    """Return the actions of a commit of a Delta log. Raises `ValueError` for what is none."""
    if not text:
        raise ValueError("is missing" if text is None else "is empty, or a link")
    try:
        actions = [json.loads(line) for line in text.decode().split("\n") if line]
    except (ValueError, RecursionError):
        raise ValueError("is not JSON") from None
    for action in actions:
        if not isinstance(action, dict) or len(action) != 1 or not action.keys() <= _KINDS:
            raise ValueError("has an action that this program never writes")
        if not all(isinstance(content, dict) for content in action.values()):
            raise ValueError("has an action without content")
    return actions


def check_commits(log: Folder, last: int | None = None) -> tuple[list[Commit], dict[str, str]]:
    """Return the commits up to a version, or all, and what is wrong with files, by name.

    Delta cleans the earliest away after 30 days; the others must follow each other.
    """
    versions = {int(name[:20]) for name in log.names() if _COMMIT.fullmatch(name)}
    newest = max(versions, default=-1) if last is None else last
    names = [f"{version:020}.json" for version in range(min(versions, default=newest), newest + 1)]
    commits: list[Commit] = []
    faults: dict[str, str] = {}
    for name, content in zip(names, log.read_many(names), strict=True):
        try:
            commit = Commit(int(name[:20]), _actions_in(content))
        except ValueError as error:
            faults[name] = str(error)
            continue
        if problem := commit.problem():
            faults[name] = problem
        commits.append(commit)
    return commits, faults


def find_commit_faults(snapshot: "Snapshot") -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the log up to a snapshot: the file's name, and what.

    While all commits are there and sound, their sum is compared with what Delta says.
    """
    if snapshot.version is None:
        return
    commits, faults = check_commits(snapshot.table.folder / LOG, snapshot.version)
    yield from faults.items()
    if faults or len(commits) <= snapshot.version:
        return
    files: set[str] = set()
    transactions: dict[str, int] = {}
    for action in (action for commit in commits for action in commit.actions):
        match action:
            case {"add": {"path": path}}:
                files.add(path)
            case {"remove": {"path": path}}:
                files.discard(path)
            case {"txn": {"appId": name, "version": number}}:
                transactions[name] = number
    if files != {file.path for file in snapshot.files}:
        yield LATEST, "the active files are not those that the commits add up to"
    if wrong := [
        name for name, number in transactions.items() if snapshot.transactions.get(name) != number
    ]:
        yield LATEST, f"does not know what has landed: {', '.join(wrong[:3])}"


def read_transactions(table: Folder, version: int) -> dict[str, int]:
    """Return the versions of all transactions committed up to a table version.

    The Delta library reads the log for each transaction. Raises `StorageError`.
    """
    return dict(_logged(table, version, "txn", "appId", "version"))


def read_removals(table: Folder, version: int) -> dict[str, int]:
    """Return the removal time of each removed file, in ms since 1970. Raises `StorageError`.

    Delta itself lists only removals before the present time of the clock. Its checkpoints drop
    removals after a week.
    """
    return dict(_logged(table, version, "remove", "path", "deletionTimestamp"))


def _logged(table: Folder, version: int, kind: str, *fields: str) -> Iterator[tuple[Any, ...]]:
    """Yield fields of all actions of a kind up to a version, the newest last."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    log = table / LOG
    names = log.names()
    checkpoints = {int(name[:20]) for name in names if _CHECKPOINT.fullmatch(name)}
    base = max((number for number in checkpoints if number <= version), default=-1)
    for name in names:  # a checkpoint may be of several files
        if base >= 0 and name.startswith(f"{base:020}.checkpoint."):
            with pq.ParquetFile(pa.BufferReader(log.read(name))) as parquet:
                rows = parquet.read(columns=[f"{kind}.{field}" for field in fields])
            actions = rows[kind].combine_chunks().drop_null()
            values = (actions.field(field).to_pylist() for field in fields)
            yield from (row for row in zip(*values, strict=True) if row[0] is not None)
    later = [name for name in names if _COMMIT.fullmatch(name) and base < int(name[:20]) <= version]
    for name, content in zip(later, log.read_many(later), strict=True):
        try:
            actions = _actions_in(content)
        except ValueError as error:
            raise StorageError(f"{log}/{name}: {error}") from None
        for action in actions:
            if kind in action and not set(fields) <= action[kind].keys():
                raise StorageError(f"{log}/{name}: was damaged: a {kind} action is incomplete.")
            if kind in action:
                yield tuple(action[kind][field] for field in fields)
