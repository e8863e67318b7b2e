"""Numbered, immutable JSON documents in a folder: 1.json, 2.json, ... with a checksum each.

Creating a document takes the next free number, or fails because another process took it. The
checksum covers the folder and the number, so a moved or copied document is refused. Anchors detect
a lost document, also the newest:

    FOLDER/5.json                  the document
    anchors/FOLDER/5.sha256        the checksum of its content, written after the document
    anchors/FOLDER/3.lost          somebody accepted the loss of document 3

A process killed between document and anchor leaves a valid folder; the next document is anchored
again. Only the newest anchor stays.
"""

import contextlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple, TypeVar

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.errors import ConflictError, QuestionError, StorageError
from fleet_slip.storage.folder import Folder

ANCHORS = "anchors"
"""Folder of the anchors. It sorts before all others, so a copy in that order takes them first."""

FORMAT = 2
"""Format of the documents."""

MAX_LOST = 100
"""Number of lost documents of a folder that are listed."""

ATTEMPTS = 1000

T = TypeVar("T")

MAX_DIGITS = 9
MAX_DEPTH = 100
"""Levels of a document. Python's own limit for JSON differs between its versions."""

_NUMBER = re.compile(rf"([1-9][0-9]{{0,{MAX_DIGITS - 1}}})\.(json|sha256|lost)")


def checksum(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a content's canonical text, in hexadecimal."""
    return sha256_of(canonical_json(content))


@dataclass(frozen=True)
class Document:
    """A document: its number, its content and the SHA-256 of the content."""

    number: int
    content: Mapping[str, Any]
    sha256: str


class Inventory(NamedTuple):
    """Numbers of the documents, of lost ones, and the highest number that was ever taken."""

    present: list[int]
    lost: list[int]
    newest: int


@dataclass(frozen=True)
class DocumentFolder:
    """A folder of numbered documents, by its path below a data root."""

    root: Folder
    path: str

    @property
    def folder(self) -> Folder:
        """The folder."""
        return self.root / self.path

    @property
    def _anchors(self) -> Folder:
        return self.root / ANCHORS / self.path

    def numbers(self) -> list[int]:
        """Return the numbers of all documents, ascending. Raises `StorageError` if one is lost."""
        return self._complete_inventory().present

    def _complete_inventory(self) -> Inventory:
        """Return the inventory. Raises `StorageError` if a document is lost."""
        inventory = self.inventory()
        if inventory.lost:
            more = f" (and {len(inventory.lost) - 1} more)" if inventory.lost[1:] else ""
            first = inventory.lost[0]
            raise StorageError(f"{self.file(first)}{more}: {self._loss(first)}")
        return inventory

    def inventory(self) -> Inventory:
        """Return which documents are present and which are lost."""
        # Anchors first: each is written after its document.
        anchors = self._anchors.names()
        accepted = _numbers_in(anchors, "lost")
        present = _numbers_in(self.folder.names(), "json")
        newest = max(present | accepted | _numbers_in(anchors, "sha256"), default=0)
        absent_numbers = (n for n in range(1, newest + 1) if n not in present and n not in accepted)
        suspects = list(islice(absent_numbers, MAX_LOST))
        # A listing may miss a document that was written meanwhile.
        contents = self.folder.read_many(list(map(document_file, suspects))) if suspects else []
        lost = [n for n, text in zip(suspects, contents, strict=True) if text is None]
        present.update(set(suspects).difference(lost))
        return Inventory(sorted(present), lost, newest)

    def read(self, number: int) -> Document:
        """Return a document. Raises `StorageError` if it was changed, moved or copied."""
        return self._read(number)[0]

    def _read(self, number: int) -> tuple[Document, bool]:
        """Return a document, and whether its file is exactly what this program writes."""
        file = self.file(number)
        text = self.folder.read(document_file(number))
        try:
            envelope = json.loads(text, object_pairs_hook=_object_of_different_keys)
            _require_depth(envelope)
            document = Document(number, envelope["content"], checksum(envelope["content"]))
            place = {key: envelope[key] for key in ("format", "folder", "number")}
            is_intact = envelope["sha256"] == _seal(place, document.sha256)
        except (ValueError, KeyError, TypeError, RecursionError):
            raise StorageError(
                f"{file}: not a document of this program, or of a development version before "
                f"0.3.0. {_RESTORE}"
            ) from None
        if not is_intact:
            raise StorageError(
                f"{file}: its content does not match its SHA-256; it was changed or damaged. "
                f"{_RESTORE}"
            )
        if place != self._place(number):
            raise StorageError(
                f"{file}: a copy of document {place['number']} of {place['folder']}, or of a later "
                f"release, in format {place['format']}. {_RESTORE} Otherwise upgrade fleet-slip."
            )
        return document, text == self._sealed(document)

    def faults(self) -> dict[str, str]:
        """Return the problems of the files of the folder, by file, down to the last byte."""
        inventory = self.inventory()
        problems = {self.file(number): self._loss(number) for number in inventory.lost}
        anchored = sorted(_numbers_in(self._anchors.names(), "sha256"))
        texts = self._anchors.read_many(list(map(_anchor, anchored)))  # None: removed meanwhile
        anchors = {number: text for number, text in zip(anchored, texts, strict=True) if text}
        for number in inventory.present:
            file = self.file(number)
            try:
                document, is_exact = self._read(number)
                if not is_exact:
                    problems[file] = "its layout was changed"
                elif anchors.get(number, _text_of(document)) != _text_of(document):
                    problems[file] = f"its anchor has another checksum: it was replaced. {_RESTORE}"
            except StorageError as error:
                problems[file] = str(error).removeprefix(f"{file}: ")
        return problems

    def append(self, content: Mapping[str, Any]) -> Document:
        """Add a document under the next free number, durably."""
        return self.after_newest(lambda newest: self.create(newest + 1, content))

    def after_newest(self, attempt: Callable[[int], T | None]) -> T:
        """Return the result of an attempt to add the next document, given the newest number or 0.

        Repeats the attempt while it returns None: another process was faster. The newest document
        may be lost, with consent. Raises `ConflictError` after `ATTEMPTS` attempts, and
        `StorageError` if a document is lost.
        """
        for _ in range(ATTEMPTS):
            outcome = attempt(self._complete_inventory().newest)
            if outcome is not None:
                return outcome
        raise ConflictError(f"{self.folder}: too many writers at once. Run the same command again.")

    def create(self, number: int, content: Mapping[str, Any]) -> Document | None:
        """Add a document under this number, durably; return None if the number is taken."""
        document = Document(number, content, checksum(content))
        file, text = document_file(number), self._sealed(document)
        # An object store's answer may be lost: then the attempt is made again and finds itself.
        if self.folder.create(file, text) or self.folder.read(file) == text:
            self._anchor(document)
            return document
        return None

    def _anchor(self, document: Document) -> None:
        """Record that a document exists, and remove earlier anchors."""
        self._anchors.create(_anchor(document.number), _text_of(document))
        with contextlib.suppress(StorageError):  # without the right to delete, they stay
            for number in sorted(_numbers_in(self._anchors.names(), "sha256"))[:-1]:
                self._anchors.delete(_anchor(number))

    def accept_loss(self, number: int) -> None:
        """Go on without a lost document, for good. Its number is not taken again."""
        self._anchors.create(f"{number}.lost", b"")

    def file(self, number: int) -> str:
        """Return the path of a document."""
        return f"{self.folder}/{document_file(number)}"

    def _loss(self, number: int) -> str:
        return (
            "the document was written and is missing. Restore the file from a backup. Without "
            f"one: fleet-slip verify --accept-loss {self.path}/{document_file(number)}"
        )

    def _place(self, number: int) -> dict[str, Any]:
        return {"format": FORMAT, "folder": self.path, "number": number}

    def _sealed(self, document: Document) -> bytes:
        place = self._place(document.number)
        seal = _seal(place, document.sha256)
        envelope = {**place, "content": document.content, "sha256": seal}
        return (json.dumps(envelope, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def document_folders(root: Folder) -> list[DocumentFolder]:
    """Return all folders below a data root that have documents, or anchors of lost ones."""
    paths: set[str] = set()
    for name in root.names():
        if name == ANCHORS:
            files = (file.path for file in (root / name).files())
            paths.update(path.rpartition("/")[0] for path in files if path.endswith(".sha256"))
        elif not (root / name / "_delta_log").exists():
            files = (f"{name}/{file.path}" for file in (root / name).files())
            paths.update(path.rpartition("/")[0] for path in files if path.endswith(".json"))
    return [DocumentFolder(root, path) for path in sorted(paths)]


def find_lost(root: Folder) -> Iterator[str]:
    """Yield a message for each folder that lacks documents."""
    for folder in document_folders(root):
        try:
            folder.numbers()
        except StorageError as error:
            yield str(error)


def accept_losses(root: Folder, paths: Iterable[str]) -> list[str]:
    """Accept the loss of documents, given by their files or folders below the root; return them.

    Raises `QuestionError` if nothing is lost there.
    """
    lost = {
        f"{folder.path}/{document_file(number)}": (folder, number)
        for folder in document_folders(root)
        for number in folder.inventory().lost
    }
    accepted = []
    for path in paths:
        chosen = [f for f, (folder, _) in lost.items() if path.rstrip("/") in (f, folder.path)]
        if not chosen:
            raise QuestionError(
                f"{path}: no document is missing there. Name a file that verify reports as "
                "missing; delete a damaged one first."
            )
        for file in chosen:
            folder, number = lost[file]
            folder.accept_loss(number)
        accepted += chosen
    return accepted


def _numbers_in(names: list[str], kind: str) -> set[int]:
    """Return the numbers in the names of files of a kind: json, sha256 or lost."""
    matches = map(_NUMBER.fullmatch, names)
    return {int(match[1]) for match in matches if match and match[2] == kind}


def _object_of_different_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object. Raises `ValueError` for a key that appears twice."""
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError("a key appears twice")
    return members


def _require_depth(value: Any) -> None:
    """Raise `ValueError` for JSON that is nested more than `MAX_DEPTH` levels."""
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [
            child
            for parent in level
            if isinstance(parent, dict | list)
            for child in (parent.values() if isinstance(parent, dict) else parent)
        ]
        if not level:
            return
    raise ValueError("nested too deeply")


def document_file(number: int) -> str:
    """Return the name of a document's file."""
    return f"{number}.json"


def _anchor(number: int) -> str:
    return f"{number}.sha256"


def _text_of(document: Document) -> bytes:
    """Return the content of a document's anchor."""
    return f"{document.sha256}\n".encode()


def _seal(place: Mapping[str, Any], sha256: str) -> str:
    """Return the checksum of a document from its place and the checksum of its content."""
    return checksum({**place, "content": sha256})


_RESTORE = "Restore the file from a backup."
