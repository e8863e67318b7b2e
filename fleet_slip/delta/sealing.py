"""Checksums of commits: what a commit does to a table, told by itself.

Delta's log has no checksums. Each commit's note therefore states the SHA-256 of the note and of
the actions that stand beside it, in a form that does not depend on how they were written as JSON.
It lands with the commit or not at all, needs no order among writers, and other programs that read
the table ignore it. `fleet_slip.delta.commit_check` compares.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from deltalake.transaction import AddAction, RemoveAction

from fleet_slip.canonical import canonical_json

NOTE = "fleet_slip"
"""Key of the note in a commit's own metadata."""

SEAL = "sha256"
"""Key of the checksum in the note."""

Action = Mapping[str, Any]
"""One action as the log has it: `{"add": {...}}`, `{"remove": {...}}`, `{"txn": {...}}`."""


def seal_note(
    note: Mapping[str, Any],
    actions: Sequence[AddAction | RemoveAction],
    units: Mapping[str, int],
) -> str:
    """Return a commit's note as text, with the checksum of itself, its actions and its units."""
    stated = [_added(a) if isinstance(a, AddAction) else _removed(a) for a in actions]
    stated += [{"txn": {"appId": name, "version": number}} for name, number in units.items()]
    return json.dumps({**note, SEAL: seal_of(note, stated)})


def seal_of(note: Mapping[str, Any], actions: Sequence[Action]) -> str:
    """Return the checksum of a note and of actions as the log has them, in any order."""
    rest = {key: value for key, value in note.items() if key != SEAL}
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
