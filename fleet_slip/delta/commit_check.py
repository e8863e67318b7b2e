"""Checks the Delta log of a table: its commits against their checksums, and its state against them.

A flipped bit in a data file's path, size or count is found beside the file. One in the name of a
unit of work, in a note or in a commit that lies behind a checkpoint is found here only.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.delta import Snapshot
from fleet_slip.delta.sealing import NOTE, SEAL, Action, seal_of
from fleet_slip.errors import StorageError

_COMMIT = re.compile(r"\d{20}\.json")
_SEALED_KINDS = frozenset({"add", "remove", "txn"})
_KINDS = _SEALED_KINDS | {"commitInfo", "metaData", "protocol"}


@dataclass(frozen=True)
class _Commit:
    name: str
    actions: Sequence[Action]

    @property
    def info(self) -> Mapping[str, Any]:
        return next((action["commitInfo"] for action in self.actions if "commitInfo" in action), {})

    @property
    def note(self) -> Mapping[str, Any]:
        return _object(self.info.get(NOTE, "{}"))

    @property
    def sealed_actions(self) -> list[Action]:
        """The actions that the commit's checksum is of; overwriting, Delta removes by itself."""
        overwriting = _parameters(self).get("mode") == "Overwrite"
        kinds = _SEALED_KINDS - {"remove"} if overwriting else _SEALED_KINDS
        return [action for action in self.actions if kinds & action.keys()]


def find_commit_faults(snapshot: Snapshot) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the log up to a snapshot: the commit's file below it, and what."""
    if snapshot.version is None:
        return
    commits = []
    must_be_sealed = False
    there = _names(snapshot)
    first = min(map(_number, there), default=snapshot.version)  # earlier ones were cleaned away
    for name in (f"{number:020}.json" for number in range(first, snapshot.version + 1)):
        if name not in there:
            yield name, "is missing"
            continue
        try:
            commit = _read(snapshot, name)
        except ValueError as error:
            yield name, str(error)
            continue
        must_be_sealed |= SEAL in commit.note
        if problem := _problem(commit, must_be_sealed):
            yield name, problem
        commits.append(commit)
    if len(commits) == snapshot.version + 1:
        yield from _state_problems(snapshot, commits)


def _names(snapshot: Snapshot) -> set[str]:
    """Return the files of the commits that the log still has, up to the snapshot's."""
    last = f"{snapshot.version:020}.json"
    names = (snapshot.table.folder / "_delta_log").names()
    return {name for name in names if _COMMIT.fullmatch(name) and name <= last}


def _number(name: str) -> int:
    return int(name.partition(".")[0])


def _read(snapshot: Snapshot, name: str) -> _Commit:
    """Return a commit. Raises `ValueError` for what is none."""
    try:
        text = snapshot.table.folder.read(f"_delta_log/{name}").decode()
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
    return _Commit(name, actions)


def _problem(commit: _Commit, must_be_sealed: bool) -> str | None:
    stated = commit.note.get(SEAL)
    if stated is not None and not _has_seal(commit, stated):
        return "its content does not match the checksum that it states"
    if stated is None and must_be_sealed and commit.sealed_actions:
        return "states no checksum, although earlier commits do: damage, or another program's"
    if _number(commit.name) == 0 and not _made_as_stated(commit):
        return "states in two ways what the table is"
    return None


def _has_seal(commit: _Commit, stated: Any) -> bool:
    try:
        return bool(stated == seal_of(commit.note, commit.sealed_actions))
    except ValueError:  # a number that is none, which only damage puts there
        return False


def _made_as_stated(commit: _Commit) -> bool:
    """Whether the commit that made the table says what it is, twice the same."""
    stated = _parameters(commit)
    made = {kind: content for action in commit.actions for kind, content in action.items()}
    return all(
        made.get(kind) == _object(stated.get(key))
        for kind, key in (("metaData", "metadata"), ("protocol", "protocol"))
    )


def _state_problems(snapshot: Snapshot, commits: Sequence[_Commit]) -> Iterator[tuple[str, str]]:
    """Compare what the commits add up to with what the Delta library says, from a checkpoint."""
    files: set[str] = set()
    units: dict[str, int] = {}
    for action in (action for commit in commits for action in commit.actions):
        match action:
            case {"add": {"path": path}}:
                files.add(path)
            case {"remove": {"path": path}}:
                files.discard(path)
            case {"txn": {"appId": name, "version": number}}:
                units[name] = number
    if files != {file.path for file in snapshot.files}:
        yield "_last_checkpoint", "the active files are not those that the commits add up to"
    wrong = [name for name, number in units.items() if snapshot.landed(name) != number]
    if wrong:
        yield "_last_checkpoint", f"does not know what has landed: {', '.join(wrong[:3])}"


def _parameters(commit: _Commit) -> Mapping[str, Any]:
    found = commit.info.get("operationParameters")
    return found if isinstance(found, Mapping) else {}


def _object(text: Any) -> Mapping[str, Any]:
    """Return a JSON object from its text; an empty one if it is none."""
    try:
        found = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
