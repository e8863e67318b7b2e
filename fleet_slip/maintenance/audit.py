"""What was forgotten: recorded without the data.

The name of a car or drive stands there as a salted hash only, so that the question "was this one
forgotten?" can be answered by who knows the name, and by no other.

    forgotten/1.json, 2.json, ...   "begun" before anything is changed, "done" after all of it
"""

import hashlib
import secrets
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder

FOLDER = "forgotten"


@dataclass(frozen=True)
class Forgettable:
    """What is to be forgotten: a vehicle, a drive, or every drive before a day."""

    kind: Literal["vehicle", "drive", "before"]
    value: str

    @property
    def column(self) -> str:
        """The column that tells."""
        return {"vehicle": "vehicle_id", "drive": "drive_id", "before": "day"}[self.kind]

    @property
    def condition(self) -> str:
        """SQL condition with the parameter `$value`."""
        if self.kind == "before":
            return "day < $value::DATE"
        return f"{self.column} = $value"

    def digest(self, salt: str) -> str:
        """Return the salted hash of the name, slow on purpose: names of cars can be listed."""
        text = f"{self.kind}:{self.value}".encode()
        return hashlib.scrypt(text, salt=bytes.fromhex(salt), n=2**14, r=8, p=1, dklen=32).hex()


@dataclass(frozen=True)
class Audit:
    """The record of what was forgotten below a data root."""

    root: Folder

    @property
    def _folder(self) -> DocumentFolder:
        return DocumentFolder(self.root / FOLDER)

    def entries(self) -> list[Mapping[str, Any]]:
        """Return all entries, oldest first."""
        return [self._folder.read(number).content for number in self._folder.numbers()]

    def state(self, subject: Forgettable) -> Literal["begun", "done"] | None:
        """Return how far forgetting a subject got; None if it was never begun."""
        mine = self._of(subject)
        return mine[-1]["event"] if mine else None

    def models_of(self, subject: Forgettable) -> list[str]:
        """Return the model versions that the last forgetting of a subject marked."""
        begun = [entry for entry in self._of(subject) if entry["event"] == "begun"]
        return list(begun[-1]["models"]) if begun else []

    def marked_models(self) -> frozenset[str]:
        """Return all model versions, NAME@VERSION, that were trained on forgotten drives."""
        return frozenset(name for entry in self.entries() for name in entry.get("models", ()))

    def begin(self, subject: Forgettable, drives: int, models: Collection[str]) -> None:
        """Record what is about to be forgotten."""
        self._append(subject, {"event": "begun", "drives": drives, "models": sorted(models)})

    def end(self, subject: Forgettable) -> None:
        """Record that it is forgotten."""
        self._append(subject, {"event": "done"})

    def _of(self, subject: Forgettable) -> list[Mapping[str, Any]]:
        entries = self.entries()
        # One salt, or more if several processes made the first entries at once.
        digests = {salt: subject.digest(salt) for salt in {entry["salt"] for entry in entries}}
        return [entry for entry in entries if entry["subject"] == digests[entry["salt"]]]

    def _append(self, subject: Forgettable, content: Mapping[str, Any]) -> None:
        entries = self.entries()
        salt = entries[0]["salt"] if entries else secrets.token_hex(16)
        at = datetime.now(UTC).isoformat(timespec="seconds")
        known = {"kind": subject.kind, "subject": subject.digest(salt), "salt": salt, "at": at}
        self._folder.append({**known, **content})
