"""What was forgotten: recorded without the data.

The name of a car or drive stands there as a salted hash only, so that the question "was this one
forgotten?" can be answered by who knows the name, and by no other.

    forgotten/1.json, 2.json, ...   "begun" before anything is changed, "done" after all of it,
                                    "allowed" where a car or drive may come back

"begun" of a drive has the hash of the only car that can send a message of it, too; and that of a
car or a drive has what tells the recordings again (`fleet_slip.warehouse.recordings`).

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
from typing import Any, Literal, TypeAlias, cast

from fleet_slip.catalogue.sources import sender_of
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder
from fleet_slip.warehouse.recordings import KnownRecordings

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
    def sender(self) -> str | None:
        """The only car, if any, whose messages it can be of; None for a time."""
        return {"vehicle": self.value, "drive": sender_of(self.value), "before": None}[self.kind]

    @property
    def condition(self) -> str:
        """SQL condition with the parameter `$value`."""
        if self.kind == "before":
            return "day < $value::DATE"
        return f"{self.column} = $value"

    def digest(self, salt: str) -> str:
        """Return the salted hash of the name, slow on purpose: names of cars can be listed."""
        return _digest(f"{self.kind}:{self.value}", salt)


@functools.lru_cache(300_000)
def _digest(text: str, salt: str) -> str:
    name = text.encode("utf-8", "surrogatepass")
    return hashlib.scrypt(name, salt=bytes.fromhex(salt), n=2**14, r=8, p=1, dklen=32).hex()


@functools.lru_cache(100_000)
def _entry(folder: DocumentFolder, number: int) -> Mapping[str, Any]:
    """Return an entry, which never changes; a night reads each once."""
    return folder.read(number).content


@functools.lru_cache(1)
def _known(kept: tuple[str, ...]) -> KnownRecordings:
    return KnownRecordings(kept)


def _digests(kind: Kind, names: Collection[str], salt: str) -> dict[str, str]:
    """Return the hash of each name, computed on all processors."""
    with ThreadPoolExecutor() as threads:  # scrypt lets others run
        found = threads.map(lambda name: Forgettable(kind, name).digest(salt), names)
        return dict(zip(names, found, strict=True))


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

    def barred(
        self, vehicles: Collection[str], drives: Collection[str], *, ended: bool = False
    ) -> Barred:
        """Return which of some cars and drives were forgotten: no row of theirs may land.

        `ended` leaves out what is still being forgotten, or was interrupted: its rows are there.
        Each name takes some 40 ms to look up, once in a process, where a car, or a drive, was ever
        forgotten; nothing where none was.
        """
        last = self._last_events()
        free = (ALLOWED, "begun") if ended else (ALLOWED,)
        found: dict[str, set[str]] = {"vehicle": set(), "drive": set()}
        for kind, names in (("vehicle", vehicles), ("drive", drives)):
            for salt in {key[1] for key in last if key[0] == kind}:
                for name, digest in _digests(cast(Kind, kind), names, salt).items():
                    if last.get((kind, salt, digest), ALLOWED) not in free:
                        found[kind].add(name)
        return Barred(frozenset(found["vehicle"]), frozenset(found["drive"]))

    def recordings(self) -> KnownRecordings | None:
        """Return the recordings of cars and drives that were forgotten; None without any."""
        last = self._last_events()
        kept = tuple(
            recording
            for e in self.entries()
            if last[e["kind"], e["salt"], e["subject"]] != ALLOWED
            for recording in e.get("recordings", ())
        )
        return _known(kept) if kept else None

    def with_forgotten_drives(self, cars: Collection[str]) -> frozenset[str]:
        """Return which of some cars can send a message of a drive that was forgotten.

        All of them, where an earlier version forgot a drive, which did not keep whose it is. As
        slow as `barred`.
        """
        last = self._last_events()
        begun = [e for e in self.entries() if (e["kind"], e["event"]) == ("drive", "begun")]
        left = [e for e in begun if last["drive", e["salt"], e["subject"]] != ALLOWED]
        if any("sender" not in entry for entry in left):
            return frozenset(cars)
        senders = {(e["salt"], e["sender"]) for e in left if e["sender"] is not None}
        found: set[str] = set()
        for salt in {salt for salt, _ in senders}:
            hashed = _digests("vehicle", cars, salt)
            found.update(name for name, digest in hashed.items() if (salt, digest) in senders)
        return frozenset(found)

    def begun(self, subject: Forgettable | None = None) -> frozenset[int]:
        """Return the numbers of the entries that bar a car or a drive, or only a subject."""
        digests = {e["salt"]: subject.digest(e["salt"]) for e in self.entries()} if subject else {}
        return frozenset(
            number
            for number, entry in enumerate(self.entries(), 1)
            if entry["event"] == "begun" and entry["kind"] != "before"
            if subject is None or entry["subject"] == digests[entry["salt"]]
        )

    def _last_events(self) -> dict[tuple[str, str, str], str]:
        """Return the last event of each subject, by its kind, salt and hash."""
        return {(e["kind"], e["salt"], e["subject"]): e["event"] for e in self.entries()}

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
        recordings: Collection[str] = (),
        source_file: str | None = None,
    ) -> None:
        """Record what is about to be forgotten.

        `models` were trained on it, of all versions up to the `judged` number of each model.
        `recordings` are those of its drives, as `Recording.kept` returns them. `source_file` is
        the file by whose name it is forgotten.
        """
        known = {"drives": drives, "models": sorted(models), "judged": dict(judged or {})}
        begun = {"event": "begun", **known, "recordings": sorted(recordings)}
        self._append(subject, begun, source_file)

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

    def allow_from(self, source_file: str) -> dict[str, str]:
        """Let the drives come back that were forgotten by the name of their file.

        Returns the event of each that was its last, by its hash; those under way are left alone.
        """
        last, found = self._last_events(), dict[str, str]()
        for entry in self.entries():
            name = _digest(f"source_file:{source_file}", entry["salt"])
            if entry.get("source_file") != name:
                continue
            key = entry["kind"], entry["salt"], entry["subject"]
            found[entry["subject"]] = last[key]
            if last[key] == "done":
                at = datetime.now(UTC).isoformat(timespec="seconds")
                told = dict(zip(("kind", "salt", "subject"), key, strict=True))
                self._folder.append({**told, "at": at, "event": ALLOWED})
                last[key] = ALLOWED
        return found

    def _of(self, subject: Forgettable) -> list[Mapping[str, Any]]:
        entries = self.entries()
        # One salt, or more if several processes made the first entries at once.
        digests = {salt: subject.digest(salt) for salt in {entry["salt"] for entry in entries}}
        return [entry for entry in entries if entry["subject"] == digests[entry["salt"]]]

    def _append(
        self, subject: Forgettable, content: Mapping[str, Any], source_file: str | None = None
    ) -> None:
        entries = self.entries()
        salt = entries[0]["salt"] if entries else secrets.token_hex(16)
        if subject.kind == "drive" and content["event"] == "begun":
            car = Forgettable("vehicle", subject.sender) if subject.sender else None
            content = {**content, "sender": car.digest(salt) if car else None}
        if source_file is not None:
            content = {**content, "source_file": _digest(f"source_file:{source_file}", salt)}
        at = datetime.now(UTC).isoformat(timespec="seconds")
        known = {"kind": subject.kind, "subject": subject.digest(salt), "salt": salt, "at": at}
        self._folder.append({**known, **content})
