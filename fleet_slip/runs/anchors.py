"""How many documents there were when a run ended, so that none can disappear unnoticed.

Numbered documents tell a gap among them, but not that the last ones are gone: a version, a move of
an alias, an entry of `forgotten/`. So every run keeps, in the history of runs, the number and the
checksum of the newest document of each folder. Whoever deletes a document would have to rewrite
the records of all runs since as well. Who can do that, and owns every copy of the history, leaves
no trace: docs/security.md.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from fleet_slip.errors import StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder
from fleet_slip.runs.records import ANCHORS, FOLDER, is_intact

Anchors = Mapping[str, tuple[int, str]]
"""Number and SHA-256 of the newest document of each folder, by its path below the data root."""


def newest_documents(root: Folder) -> dict[str, tuple[int, str]]:
    """Return the anchors as they are now; nothing of a folder that cannot be read."""
    found = {}
    for path in _document_folders(root):
        documents = _documents(root, path)
        with contextlib.suppress(StorageError):
            if numbers := documents.numbers():
                found[path] = (numbers[-1], documents.read(numbers[-1]).sha256)
    return found


def find_missing_documents(root: Folder, since: str = "") -> Iterator[tuple[str, str]]:
    """Yield the folders that have lost documents that a run had seen, and what is wrong.

    `since` is the first month whose records are looked at, as YYYY-MM.
    """
    for path, (number, sha256) in sorted(_kept_anchors(root, since).items()):
        documents = _documents(root, path)
        newest = max(documents.numbers(), default=0)
        if newest < number:
            yield path, f"had {number} documents when a run ended, and has {newest} now"
            continue
        with contextlib.suppress(StorageError):  # told as a document
            if documents.read(number).sha256 != sha256:
                yield path, f"{number}.json is not the document that a run had seen"


def _kept_anchors(root: Folder, since: str) -> dict[str, tuple[int, str]]:
    folder = root / FOLDER
    paths = [f.path for f in folder.files() if f.path.endswith(".jsonl") and f.path >= since]
    kept: dict[str, tuple[int, str]] = {}
    for content in folder.read_many(paths):
        for line in (content or b"").splitlines():
            for path, number, sha256 in _anchors_in(line):
                if number >= kept.get(path, (0, ""))[0]:
                    kept[path] = (number, sha256)
    return kept


def _anchors_in(line: bytes) -> Iterator[tuple[str, int, str]]:
    """Yield the anchors of a record; none of a line that is torn, changed, or without them."""
    if not is_intact(line):
        return
    try:
        record: Any = json.loads(line)
        found = record.get(ANCHORS) or {}
        for path, (number, sha256) in found.items():
            if _is_document_folder(str(path)):
                yield str(path), int(number), str(sha256)
    except (ValueError, TypeError, AttributeError, RecursionError):
        return


def _document_folders(root: Folder) -> list[str]:
    models = [f"models/{name}" for name in (root / "models").names()]
    return [
        "forgotten",
        *(f"{model}/{kind}" for model in models for kind in ("versions", "history")),
    ]


def _is_document_folder(path: str) -> bool:
    parts = path.split("/")
    if path == "forgotten":
        return True
    known = len(parts) == 3 and parts[0] == "models" and parts[2] in ("versions", "history")
    return known and ".." not in parts


def _documents(root: Folder, path: str) -> DocumentFolder:
    folder = root
    for part in path.split("/"):
        folder = folder / part
    return DocumentFolder(folder)
