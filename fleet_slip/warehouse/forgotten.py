"""What was forgotten: recorded without the data.

The name of a car or drive stands there as a hash only, keyed with a secret of the data root. So the
question "was this one forgotten?" can be answered by who has the root and knows the name.

    forgotten/1.json, 2.json, ...   "begun" before anything is changed, "done" after all of it,
                                    "allowed" where a car or drive may come back

"begun" of a car or a drive has the digests of the drives' counts too, which tell a drive that comes
again under another name: of its log (`digest_counts`) and of its Gram rows (`gram_digests`).
Releases up to 0.2 hashed names with scrypt, 40 ms each, and kept other hashes of samples: their
names still count, their samples do not.

Names are hashed after `name_key`: `V1`, ` v1 ` and `V1` are one car. Entries of earlier releases
have the hash of the name as it was typed.

Who lands rows asks `barred` between looking at the table and committing to it. Who forgets writes
"begun" and then fences the table (`Table.fence`). So a commit either began after the fence, and its
writer has read the entry; or it began before, and is a conflict; or it landed before the fence, and
who forgets sees its rows.
"""

import functools
import hashlib
import secrets
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal, TypeAlias

from fleet_slip.base import name_key, normalize_name, number_of
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder

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

    def select(self, names: Iterable[str | None]) -> list[str]:
        """Return those names that erasure compares as equal to the subject's."""
        key = name_key(self.value)
        return [name for name in names if name is not None and name_key(name) == key]


_SCRYPT = "scrypt:"


def _digests(kind: str, name: str, key: str) -> set[str]:
    """Return the keyed hashes under which an entry of this release or an earlier one has a name."""
    names = {name, normalize_name(name)}
    if not key.startswith(_SCRYPT):  # slow, and used by releases that hashed names as typed
        names.add(name_key(name))
    return {_digest(f"{kind}:{form}", key) for form in names}


@functools.lru_cache(300_000)
def _digest(text: str, key: str) -> str:
    name = text.encode("utf-8", "surrogatepass")
    if key.startswith(_SCRYPT):
        salt = bytes.fromhex(key.removeprefix(_SCRYPT))
        return hashlib.scrypt(name, salt=salt, n=2**14, r=8, p=1, dklen=32).hex()
    return hashlib.blake2b(name, key=bytes.fromhex(key), digest_size=32).hexdigest()


@functools.lru_cache(100_000)
def _entry(folder: DocumentFolder, number: int) -> Mapping[str, Any]:
    """Return an entry, which never changes; a night reads each once."""
    entry = folder.read(number).content
    return entry if "key" in entry else {**entry, "key": f"{_SCRYPT}{entry['salt']}"}


@dataclass(frozen=True)
class Barred:
    """Cars and drives that were forgotten and not allowed again, among some."""

    vehicles: frozenset[str] = frozenset()
    drives: frozenset[str] = frozenset()

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.vehicles or self.drives)


def skipped_drives(number: int) -> str:
    """Return the end of a sentence on drives that did not land; nothing if there are none."""
    allow = "fleet-slip forget --allow readmits them"
    return f"; {number_of(number, 'drive')} skipped: forgotten before ({allow})" if number else ""


@dataclass(frozen=True)
class Audit:
    """The record of what was forgotten below a data root."""

    root: Folder

    @property
    def _folder(self) -> DocumentFolder:
        return DocumentFolder(self.root, FOLDER)

    def entries(self) -> list[Mapping[str, Any]]:
        """Return all entries, oldest first."""
        return [_entry(self._folder, number) for number in self._folder.numbers()]

    def barred(
        self, vehicles: Collection[str], drives: Collection[str], *, ended: bool = False
    ) -> Barred:
        """Return which of some cars and drives were forgotten: no row of theirs may land.

        `ended` leaves out what is still being forgotten, or was interrupted: its rows are there.
        """
        last = self._last_events()
        free = (ALLOWED, "begun") if ended else (ALLOWED,)
        found: dict[str, frozenset[str]] = {}
        for kind, names in (("vehicle", vehicles), ("drive", drives)):
            keys = {key for each, key, _ in last if each == kind}
            found[kind] = frozenset(
                name
                for name in (names if keys else ())
                for key in keys
                for digest in _digests(kind, name, key)
                if last.get((kind, key, digest), ALLOWED) not in free
            )
        return Barred(found["vehicle"], found["drive"])

    def barred_counts(self) -> frozenset[str]:
        """Return the digests of the counts of drives that were forgotten."""
        last = self._last_events()
        return frozenset(
            digest
            for entry in self.entries()
            if last[_subject_of(entry)] != ALLOWED
            for digest in entry.get("counts", ())
        )

    def begun(self) -> frozenset[int]:
        """Return the numbers of the entries that bar a car or a drive."""
        return frozenset(
            number
            for number, entry in zip(self._folder.numbers(), self.entries(), strict=False)
            if entry["event"] == "begun" and entry["kind"] != "before"
        )

    def _last_events(self) -> dict[tuple[str, str, str], str]:
        """Return the last event of each subject, by its kind, key and hash."""
        return {_subject_of(entry): entry["event"] for entry in self.entries()}

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
        counts: Collection[str] = (),
    ) -> None:
        """Record what is about to be forgotten.

        `models` were trained on it, of all versions up to the `judged` number of each model.
        `counts` are the digests of its drives' counts.
        """
        known = {"drives": drives, "models": sorted(models), "judged": dict(judged or {})}
        self._append(subject, {"event": "begun", **known, "counts": sorted(counts)})

    def end(self, subject: Forgettable, grams_version: int | None = None) -> None:
        """Record that it is forgotten, and since which version the Gram rows are without it."""
        done = {"event": "done", "grams_version": grams_version, "names_are_exact": True}
        self._append(subject, done)

    @property
    def names_are_exact(self) -> bool:
        """Whether names that no row has were taken out of all files, as since then none has any."""
        return any(entry.get("names_are_exact") for entry in self.entries())

    @property
    def allows_drives(self) -> bool:
        """Whether some drive that was forgotten may come back."""
        return any(k[0] == "drive" and e == ALLOWED for k, e in self._last_events().items())

    def allow(self, subject: Forgettable) -> None:
        """Record that a forgotten car or drive may come back."""
        self._append(subject, {"event": ALLOWED})

    def _of(self, subject: Forgettable) -> list[Mapping[str, Any]]:
        return [
            entry
            for entry in self.entries()
            if entry["subject"] in _digests(subject.kind, subject.value, entry["key"])
        ]

    def _append(self, subject: Forgettable, content: Mapping[str, Any]) -> None:
        # One key, or more if several processes made the first entries at once.
        keys = [e["key"] for e in self.entries() if not e["key"].startswith(_SCRYPT)]
        key = keys[0] if keys else secrets.token_hex(32)
        at = datetime.now(UTC).isoformat(timespec="seconds")
        earlier = [(entry["subject"], entry["key"]) for entry in self._of(subject)]
        digest = _digest(f"{subject.kind}:{name_key(subject.value)}", key)
        for hashed, under in dict.fromkeys([*earlier, (digest, key)]):
            known = {"kind": subject.kind, "subject": hashed, "key": under, "at": at}
            self._folder.append({**known, **content})


def _subject_of(entry: Mapping[str, Any]) -> tuple[str, str, str]:
    return entry["kind"], entry["key"], entry["subject"]
