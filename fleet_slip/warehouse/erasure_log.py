"""The erasure log: which cars and drives were erased, without their names or data.

An entry contains a keyed hash of the name, with a secret key of the data root. So whoever has the
root and a name can ask whether it was erased.

    forgotten/1.json, 2.json, ...   "begun" before any change, "done" after all of them,
                                    "allowed" where a car or drive may return

"begun" of a car or drive also contains the digests of the drives' counts, by which a drive under
another name is recognised: of its log (`digest_counts`) and of its Gram rows (`gram_digests`).

Names are hashed after `name_key`: `V1`, ` v1 ` and `V1` are one car. Entries of earlier releases
contain the hash of the name as typed.

A writer of rows calls `erased` between reading the table and committing to it. An erasure writes
"begun" and then fences the table (`Table.fence`). So a commit either began after the fence, and its
writer has read the entry; or it began before, and is a conflict; or it landed before the fence, and
the erasure reads its rows.
"""

import functools
import hashlib
import secrets
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Any, Literal, TypeAlias

from fleet_slip.base import name_key, normalize_name, pluralize
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import StorageError
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.table import Snapshot, Table

FOLDER = "forgotten"
ALLOWED = "allowed"

SubjectKind: TypeAlias = Literal["vehicle", "drive", "before"]


@dataclass(frozen=True)
class ErasureSubject:
    """Subject of an erasure: a vehicle, a drive, or every drive before a day.

    `kept_days` are days before that day whose drives stay.
    """

    kind: SubjectKind
    value: str
    kept_days: frozenset[date] = frozenset()

    @property
    def column(self) -> str:
        """The column that identifies the subject's rows."""
        return {"vehicle": "vehicle_id", "drive": "drive_id", "before": "day"}[self.kind]

    def select(self, names: Iterable[str | None]) -> list[str]:
        """Return the names that erasure compares as equal to the subject's."""
        key = name_key(self.value)
        return [name for name in names if name is not None and name_key(name) == key]


@dataclass(frozen=True)
class ErasedIds:
    """Names of erased cars and drives."""

    vehicles: frozenset[str] = frozenset()
    drives: frozenset[str] = frozenset()

    def __bool__(self) -> bool:
        """Return True if there are any."""
        return bool(self.vehicles or self.drives)

    @property
    def by_column(self) -> dict[str, list[str]]:
        """The names, sorted, by the column that contains them."""
        return {"vehicle_id": sorted(self.vehicles), "drive_id": sorted(self.drives)}


def _digests(kind: str, name: str, key: str) -> set[str]:
    """Return the keyed hashes under which an entry of any release has a name."""
    forms = {name, normalize_name(name), name_key(name)}
    return {_digest(f"{kind}:{form}", key) for form in forms}


@functools.lru_cache(300_000)
def _digest(text: str, key: str) -> str:
    name = text.encode("utf-8", "surrogatepass")
    return hashlib.blake2b(name, key=bytes.fromhex(key), digest_size=32).hexdigest()


@functools.lru_cache(100_000)
def _entry(folder: DocumentFolder, number: int) -> Mapping[str, Any]:
    """Return an entry. Entries never change, so each is read once."""
    return folder.read(number).content


def skipped_drives(count: int) -> str:
    """Return the end of a sentence on drives that were not written; empty for none."""
    allow = "fleet-slip forget --allow admits new rows"
    return f"; {pluralize(count, 'drive')} skipped: forgotten before ({allow})" if count else ""


@dataclass(frozen=True)
class ErasureLog:
    """The erasure log of a data root."""

    root: Folder

    @property
    def _folder(self) -> DocumentFolder:
        return DocumentFolder(self.root, FOLDER)

    def entries(self) -> list[Mapping[str, Any]]:
        """Return all entries, oldest first."""
        return [_entry(self._folder, number) for number in self._folder.numbers()]

    def erased(
        self, vehicles: Collection[str], drives: Collection[str], *, ended: bool = False
    ) -> ErasedIds:
        """Return which of these cars and drives are erased: no row of theirs may be written.

        `ended` leaves out erasures that are under way or were interrupted: their rows may exist.
        """
        last = self._last_events()
        ignored = (ALLOWED, "begun") if ended else (ALLOWED,)
        erased: dict[str, frozenset[str]] = {}
        for kind, names in (("vehicle", vehicles), ("drive", drives)):
            keys = {key for other, key, _ in last if other == kind}
            erased[kind] = frozenset(
                name
                for name in (names if keys else ())
                for key in keys
                for digest in _digests(kind, name, key)
                if last.get((kind, key, digest), ALLOWED) not in ignored
            )
        return ErasedIds(erased["vehicle"], erased["drive"])

    def erased_count_digests(self) -> frozenset[str]:
        """Return the digests of the counts of erased drives."""
        last = self._last_events()
        return frozenset(
            digest
            for entry in self.entries()
            if last[_subject_key(entry)] != ALLOWED
            for digest in entry.get("counts", ())
        )

    def begun(self) -> frozenset[int]:
        """Return the numbers of the entries that begin the erasure of a car or a drive."""
        return frozenset(
            number
            for number, entry in zip(self._folder.numbers(), self.entries(), strict=False)
            if entry["event"] == "begun" and entry["kind"] != "before"
        )

    def _last_events(self) -> dict[tuple[str, str, str], str]:
        """Return the last event of each subject, by kind, key and hash."""
        return {_subject_key(entry): entry["event"] for entry in self.entries()}

    def state(self, subject: ErasureSubject) -> Literal["begun", "done", "allowed"] | None:
        """Return the last event of a subject; None without one."""
        entries = self._entries_of(subject)
        return entries[-1]["event"] if entries else None

    def models_of(self, subject: ErasureSubject) -> list[str]:
        """Return the model versions that the last erasure of a subject marked."""
        begun = [entry for entry in self._entries_of(subject) if entry["event"] == "begun"]
        return list(begun[-1]["models"]) if begun else []

    def begin(
        self,
        subject: ErasureSubject,
        drives: int,
        models: Collection[str],
        judged: Mapping[str, int] | None = None,
        counts: Collection[str] = (),
    ) -> None:
        """Record the beginning of an erasure.

        `models` were trained on the subject; versions up to the number in `judged`, by model name,
        were examined. `counts` are the digests of the drives' counts.
        """
        impact = {"drives": drives, "models": sorted(models), "judged": dict(judged or {})}
        self._append(subject, {"event": "begun", **impact, "counts": sorted(counts)})

    def end(self, subject: ErasureSubject, grams_version: int | None = None) -> None:
        """Record the end, and the version since which the Gram rows are without the subject."""
        done = {"event": "done", "grams_version": grams_version}
        self._append(subject, done)

    @property
    def allows_drives(self) -> bool:
        """True if an erased drive may return."""
        events = self._last_events().items()
        return any(kind == "drive" and event == ALLOWED for (kind, _, _), event in events)

    def allow(self, subject: ErasureSubject) -> None:
        """Record that an erased car or drive may return."""
        self._append(subject, {"event": ALLOWED})

    def _entries_of(self, subject: ErasureSubject) -> list[Mapping[str, Any]]:
        return [
            entry
            for entry in self.entries()
            if entry["subject"] in _digests(subject.kind, subject.value, entry["key"])
        ]

    def _append(self, subject: ErasureSubject, content: Mapping[str, Any]) -> None:
        # One key, or more if several processes made the first entries at once.
        entries = self.entries()
        key = entries[0]["key"] if entries else secrets.token_hex(32)
        at = datetime.now(UTC).isoformat(timespec="seconds")
        earlier = [(entry["subject"], entry["key"]) for entry in self._entries_of(subject)]
        digest = _digest(f"{subject.kind}:{name_key(subject.value)}", key)
        for hashed, entry_key in dict.fromkeys([*earlier, (digest, key)]):
            head = {"kind": subject.kind, "subject": hashed, "key": entry_key, "at": at}
            self._folder.append({**head, **content})


def _subject_key(entry: Mapping[str, Any]) -> tuple[str, str, str]:
    return entry["kind"], entry["key"], entry["subject"]


# Rows of erased cars and drives that the tables have again, as after restoring an old backup: its
# tables may be older than the log. Views leave these rows out, and `status` reports them.


def find_erased(
    root: Folder, grams: Table, snapshots: Sequence[Snapshot], *, ended: bool = False
) -> ErasedIds:
    """Return the erased cars and drives that tables have rows of.

    The table `grams` names the drives of most log files. A root without erasures costs one listing
    of the log's folder. `ended` leaves out erasures that are under way. An unreadable file is
    skipped: a query of its rows fails by itself.
    """
    erasure_log = ErasureLog(root)
    if not erasure_log.begun():
        return ErasedIds()
    if not any(snapshot.table == grams for snapshot in snapshots):
        with suppress(StorageError):
            snapshots = [grams.snapshot(), *snapshots]
    vehicles: set[str | None] = set()
    drives: set[str | None] = set()
    for vehicle_names, drive_names in _names_in(grams, snapshots):
        vehicles.update(vehicle_names)
        drives.update(drive_names)
    return erasure_log.erased(
        {name for name in vehicles if name}, {name for name in drives if name}, ended=ended
    )


def without_erased(rows: str, erased: ErasedIds) -> str:
    """Return the SQL of rows without those of erased cars and drives.

    Their names are the variables `erased_vehicle_id` and `erased_drive_id`.
    """
    predicates = [
        f"coalesce({column} NOT IN (SELECT unnest(getvariable('erased_{column}'))), true)"
        for column, names in erased.by_column.items()
        if names
    ]
    return f"(FROM {rows} WHERE {' AND '.join(predicates)})" if predicates else rows


_Names: TypeAlias = Iterable[str | None]


def _names_in(grams: Table, snapshots: Sequence[Snapshot]) -> Iterator[tuple[_Names, _Names]]:
    """Yield the vehicles and drives of files. A log file with Gram rows is not opened."""
    import pyarrow.compute as pc

    files_with_grams: set[str] = set()
    for snapshot in sorted(snapshots, key=lambda snapshot: snapshot.table != grams):
        is_grams = snapshot.table == grams
        columns = ["vehicle_id", "drive_id", *(["feature_set", "file"] if is_grams else [])]
        for file in snapshot.files:
            if file.path in files_with_grams:
                continue
            with suppress(StorageError):
                rows = snapshot.table.read_combinations(file.path, columns)
                if is_grams:
                    plain = pc.equal(rows["feature_set"], PLAIN)
                    files_with_grams.update(rows["file"].filter(plain).to_pylist())
                yield rows["vehicle_id"].to_pylist(), rows["drive_id"].to_pylist()
