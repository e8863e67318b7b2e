"""Numbered, immutable JSON documents in a folder: 1.json, 2.json, ... with a checksum each.

A document is written under a temporary name, flushed, then linked to the next free number, which
fails if another process took that number first. So numbers are consecutive, no document is ever
half there, and none is replaced.
"""

import hashlib
import json
import os
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.storage import TEMPORARY_PREFIX, flush, storage_errors

ATTEMPTS = 1000

MAX_DIGITS = 9
"""Digits of a document's number."""

_NUMBER = re.compile(rf"[1-9][0-9]{{0,{MAX_DIGITS - 1}}}")


def canonical_json(content: Mapping[str, Any]) -> str:
    """Return the one text of a JSON document that its checksum is taken from."""
    return json.dumps(
        content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def checksum(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a document's canonical text, in hexadecimal."""
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


@dataclass(frozen=True)
class Document:
    """One document: its number, its content and the checksum that was verified."""

    number: int
    content: Mapping[str, Any]
    sha256: str


@dataclass(frozen=True)
class DocumentFolder:
    """A folder of numbered documents."""

    path: Path

    def numbers(self) -> list[int]:
        """Return the numbers of all documents, ascending."""
        with storage_errors(self.path):
            if not self.path.is_dir():
                return []
            stems = (file.stem for file in self.path.glob("*.json"))
            return sorted(int(stem) for stem in stems if _NUMBER.fullmatch(stem))

    def read(self, number: int) -> Document:
        """Return a document. Raises `StorageError` if its checksum does not match."""
        file = self.file(number)
        with storage_errors(file):
            text = file.read_bytes()
        try:
            envelope = json.loads(text)
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

    def faults(self) -> dict[Path, str]:
        """Return what is wrong with the files of the folder, by file, down to the last byte."""
        found = {}
        numbers = self.numbers()
        for number in sorted({*numbers, *range(1, max(numbers, default=0) + 1)}):
            file = self.file(number)
            try:
                document = self.read(number)
                if file.read_bytes() != _rendered(document.content, document.sha256).encode():
                    found[file] = "its layout was changed"
            except StorageError as error:
                found[file] = str(error).removeprefix(f"{file}: ")
        return found

    def append(self, content: Mapping[str, Any]) -> Document:
        """Add a document under the next free number, durably."""
        sha256 = checksum(content)
        text = _rendered(content, sha256)
        temporary = self.path / f"{TEMPORARY_PREFIX}{uuid.uuid4().hex}"
        with storage_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            try:
                with temporary.open("x", encoding="utf-8") as file:
                    file.write(text)
                    file.flush()
                    os.fsync(file.fileno())
                number = self._link_to_next_number(temporary)
            finally:
                temporary.unlink(missing_ok=True)
            flush(self.path)
        return Document(number, content, sha256)

    def _link_to_next_number(self, temporary: Path) -> int:
        number = max(self.numbers(), default=0)
        for _ in range(ATTEMPTS):
            number += 1
            try:
                self.file(number).hardlink_to(temporary)
            except FileExistsError:
                continue
            return number
        raise ConflictError(f"{self.path}: too many writers at once. Run the same command again.")

    def file(self, number: int) -> Path:
        """Return where a document of this number is."""
        return self.path / f"{number}.json"


def _rendered(content: Mapping[str, Any], sha256: str) -> str:
    document = {"content": content, "sha256": sha256}
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


_RESTORE = "Restore the file from a backup, or publish again."
