"""Numbered, immutable JSON documents in a folder: 1.json, 2.json, ... with a checksum each.

Creating one takes the next free number, or fails as another process took it: numbers are
consecutive, none is half there, and what follows from the newest comes right after it.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.storage.folder import Folder

ATTEMPTS = 1000

T = TypeVar("T")

MAX_DIGITS = 9
MAX_DEPTH = 100
"""Levels of a document. Python's own limit for JSON differs between its versions."""

_NUMBER = re.compile(rf"([1-9][0-9]{{0,{MAX_DIGITS - 1}}})\.json")


def checksum(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a document's canonical text, in hexadecimal."""
    return sha256_of(canonical_json(content))


@dataclass(frozen=True)
class Document:
    """One document: its number, its content and the checksum that was verified."""

    number: int
    content: Mapping[str, Any]
    sha256: str


@dataclass(frozen=True)
class DocumentFolder:
    """A folder of numbered documents."""

    folder: Folder

    def numbers(self) -> list[int]:
        """Return the numbers of all documents, ascending."""
        found = map(_NUMBER.fullmatch, self.folder.names())
        return sorted(int(number[1]) for number in found if number)

    def read(self, number: int) -> Document:
        """Return a document. Raises `StorageError` if its checksum does not match."""
        file = self.file(number)
        text = self.folder.read(document_file(number))
        try:
            envelope = json.loads(text, object_pairs_hook=_object_of_different_keys)
            _require_depth(envelope)
            content, stated = envelope["content"], envelope["sha256"]
            found = checksum(content)
        except (ValueError, KeyError, TypeError, RecursionError):
            raise StorageError(f"{file}: not a document of this program. {_RESTORE}") from None
        if found != stated:
            raise StorageError(
                f"{file}: its content does not match its SHA-256; it was changed or damaged. "
                f"{_RESTORE}"
            )
        return Document(number, content, stated)

    def faults(self) -> dict[str, str]:
        """Return what is wrong with the files of the folder, by file, down to the last byte."""
        found = {}
        numbers = self.numbers()
        for number in sorted({*numbers, *range(1, max(numbers, default=0) + 1)}):
            file = self.file(number)
            try:
                document = self.read(number)
                if self.folder.read(document_file(number)) != _rendered(document):
                    found[file] = "its layout was changed"
            except StorageError as error:
                found[file] = str(error).removeprefix(f"{file}: ")
        return found

    def append(self, content: Mapping[str, Any]) -> Document:
        """Add a document under the next free number, durably."""
        return self.after_newest(lambda newest: self.create(newest + 1, content))

    def after_newest(self, attempt: Callable[[int], T | None]) -> T:
        """Return what an attempt to add the next document comes to, given the newest number or 0.

        It is made again while it is None: another was faster. Raises `ConflictError` after very
        many.
        """
        for _ in range(ATTEMPTS):
            outcome = attempt(max(self.numbers(), default=0))
            if outcome is not None:
                return outcome
        raise ConflictError(f"{self.folder}: too many writers at once. Run the same command again.")

    def create(self, number: int, content: Mapping[str, Any]) -> Document | None:
        """Add a document under this number, durably; return None if the number is taken."""
        document = Document(number, content, checksum(content))
        file, text = document_file(number), _rendered(document)
        # An object store's answer may be lost: then the attempt is made again and finds itself.
        if self.folder.create(file, text) or self.folder.read(file) == text:
            return document
        return None

    def file(self, number: int) -> str:
        """Return where a document of this number is."""
        return f"{self.folder}/{document_file(number)}"


def _object_of_different_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object. Raises `ValueError` for a key that stands twice: who reads which?"""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key appears twice")
    return found


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


def _rendered(document: Document) -> bytes:
    envelope = {"content": document.content, "sha256": document.sha256}
    return (json.dumps(envelope, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


_RESTORE = "Restore the file from a backup, or publish again."
