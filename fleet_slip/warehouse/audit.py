"""What was forgotten: recorded without the data.

The name of a car or drive stands there as a salted hash only, so that the question "was this one
forgotten?" can be answered by who knows the name, and by no other.

    forgotten/1.json, 2.json, ...   "begun" before anything is changed, "done" after all of it,
                                    "allowed" where a car or drive may come back

Who lands rows asks `barred` between looking at the table and committing to it. Who forgets writes
"begun" and then fences the table (`Table.fence`). So a commit either began after the fence, and its
writer has read the entry; or it began before, and is a conflict; or it landed before the fence, and
who forgets sees its rows.
"""

import functools
import hashlib
import secrets
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any, Literal, TypeAlias, cast

from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder

FOLDER = "forgotten"
ALLOWED = "allowed"

Kind: TypeAlias = Literal["vehicle", "drive", "before"]


@dataclass(frozen=True)
class Forgettable:
    """What is to be forgotten: a vehicle, a drive, or every drive before a day."""

    kind: Kind
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
        return _digest(f"{self.kind}:{self.value}", salt)


@functools.lru_cache(100_000)
def _digest(text: str, salt: str) -> str:
    name = text.encode("utf-8", "surrogatepass")
    return hashlib.scrypt(name, salt=bytes.fromhex(salt), n=2**14, r=8, p=1, dklen=32).hex()


@functools.lru_cache(100_000)
def _entry(folder: DocumentFolder, number: int) -> Mapping[str, Any]:
    """Return an entry, which never changes; a night reads each once."""
    return folder.read(number).content


def _digest_of(salt: str, subject: Forgettable) -> str:
    return subject.digest(salt)


@dataclass(frozen=True)
class Barred:
    """Cars and drives that were forgotten and not allowed again, among some."""

    vehicles: frozenset[str] = frozenset()
    drives: frozenset[str] = frozenset()

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.vehicles or self.drives)


@dataclass(frozen=True)
class Audit:
    """The record of what was forgotten below a data root."""

    root: Folder

    @property
    def _folder(self) -> DocumentFolder:
        return DocumentFolder(self.root / FOLDER)

    def entries(self) -> list[Mapping[str, Any]]:
        """Return all entries, oldest first."""
        return [_entry(self._folder, number) for number in self._folder.numbers()]

    def barred(self, vehicles: Collection[str], drives: Collection[str]) -> Barred:
        """Return which of some cars and drives were forgotten: no row of theirs may land.

        Each name takes some 40 ms to look up, once in a process, where a car, or a drive, was ever
        forgotten; nothing where none was.
        """
        last = {(e["kind"], e["salt"], e["subject"]): e["event"] for e in self.entries()}
        named = {"vehicle": vehicles, "drive": drives}
        found: dict[str, set[str]] = {"vehicle": set(), "drive": set()}
        with ThreadPoolExecutor() as threads:  # scrypt lets others run
            for kind, salt in sorted({key[:2] for key in last if key[0] in named}):
                names = sorted(named[kind])
                subjects = [Forgettable(cast(Kind, kind), name) for name in names]
                digests = threads.map(partial(_digest_of, salt), subjects)
                for name, digest in zip(names, digests, strict=True):
                    if last.get((kind, salt, digest), ALLOWED) != ALLOWED:
                        found[kind].add(name)
        return Barred(frozenset(found["vehicle"]), frozenset(found["drive"]))

    def state(self, subject: Forgettable) -> Literal["begun", "done", "allowed"] | None:
        """Return how far forgetting a subject got; None if it was never begun."""
        mine = self._of(subject)
        return mine[-1]["event"] if mine else None

    def models_of(self, subject: Forgettable) -> list[str]:
        """Return the model versions that the last forgetting of a subject marked."""
        begun = [entry for entry in self._of(subject) if entry["event"] == "begun"]
        return list(begun[-1]["models"]) if begun else []

    def begin(
        self,
        subject: Forgettable,
        drives: int,
        models: Collection[str],
        judged: Mapping[str, int] | None = None,
    ) -> None:
        """Record what is about to be forgotten.

        `models` were trained on it, of all versions up to the `judged` number of each model.
        """
        known = {"drives": drives, "models": sorted(models), "judged": dict(judged or {})}
        self._append(subject, {"event": "begun", **known})

    def end(self, subject: Forgettable, grams_version: int | None = None) -> None:
        """Record that it is forgotten, and since which version the Gram rows are without it."""
        self._append(subject, {"event": "done", "grams_version": grams_version})

    def allow(self, subject: Forgettable) -> None:
        """Record that a forgotten car or drive may come back."""
        self._append(subject, {"event": ALLOWED})

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
