"""The commits of a table's Delta log as they stand there, and what is wrong with one."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.delta.sealing import NOTE, SEAL, Action, seal_of
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder

LOG = "_delta_log"

COMMIT_FILE = re.compile(r"\d{20}\.json")
_SEALED_KINDS = frozenset({"add", "remove", "txn"})
_KINDS = _SEALED_KINDS | {"commitInfo", "metaData", "protocol"}


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
    def sealed_actions(self) -> list[Action]:
        """The actions that the commit's checksum is of; overwriting, Delta removes by itself."""
        overwriting = _parameters(self).get("mode") == "Overwrite"
        kinds = _SEALED_KINDS - {"remove"} if overwriting else _SEALED_KINDS
        return [action for action in self.actions if kinds & action.keys()]


def commit_number(name: str) -> int:
    """Return the version that a commit's file makes."""
    return int(name.partition(".")[0])


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


def problem_of_commit(commit: Commit, must_be_sealed: bool) -> str | None:
    """Return what is wrong with a commit, or None."""
    stated = commit.note.get(SEAL)
    if stated is not None and not _has_seal(commit, stated):
        return "its content does not match the checksum that it states"
    if stated is None and must_be_sealed and commit.sealed_actions:
        return "states no checksum, although earlier commits do: damage, or another program's"
    if commit_number(commit.name) == 0 and not _made_as_stated(commit):
        return "states in two ways what the table is"
    return None


def _has_seal(commit: Commit, stated: Any) -> bool:
    try:
        return bool(stated == seal_of(commit.note, commit.sealed_actions))
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
