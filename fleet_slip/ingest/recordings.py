"""Detects recordings that are stored already or were erased: neither is stored again."""

import json
import os
import re
from collections.abc import Collection, Iterable, Sequence
from collections.abc import Mapping as Named
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import pluralize, quote_name
from fleet_slip.errors import RepeatedError
from fleet_slip.ingest.log_files import state_of
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_log import MeasuredLog
from fleet_slip.ingest.ticks import FINGERPRINT_PREFIX, MeasuredDrive
from fleet_slip.resources import cache_folder, keep_json
from fleet_slip.storage.table import (
    WITHDRAWN,
    AppTransaction,
    Change,
    Table,
    retry_conflicts,
)
from fleet_slip.warehouse.erasure_log import ALLOWED, ErasureLog, ErasureSubject
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.warehouse import Warehouse

TableName: TypeAlias = Literal["quarantine", "logs"]
Replace: TypeAlias = Literal["no", "corrected", "all"]
"""Stored recordings that a new one replaces: `corrected` are those of the same file, ingested with
an earlier mapping of the same name."""


def tables_of(warehouse: Warehouse) -> dict[TableName, Table]:
    """Return the tables that files are written to, in the order of commits."""
    return {"quarantine": warehouse.quarantine, "logs": warehouse.logs}


# Erased cars and drives are not stored again.


def drop_erased_drives(
    drives: Sequence[MeasuredDrive], erasure_log: ErasureLog
) -> list[MeasuredDrive]:
    """Return the drives without those that were erased, under any name, or whose cars were."""
    cars = {drive.drive_id: str(drive.metadata["vehicle_id"]) for drive in drives}
    erased = erasure_log.erased(set(cars.values()), set(cars))
    counts = erasure_log.erased_count_digests()
    return [
        drive
        for drive in drives
        if drive.drive_id not in erased.drives
        and cars[drive.drive_id] not in erased.vehicles
        and not (counts and drive.counts_digest in counts)
    ]


def drop_erased_rejects(
    rejected: pa.Table, erasure_log: ErasureLog, erased_drives: Collection[str] = ()
) -> pa.Table:
    """Return the rejected rows without those of erased cars and drives.

    `erased_drives` are those of their file. A rejected row contains the name of the drive
    before it was cut; the names of the segments begin with it.
    """
    vehicles, named = (
        set(rejected[column].unique().drop_null().cast(pa.string()).to_pylist())
        for column in ("vehicle_id", "drive_id")
    )
    erased = erasure_log.erased(vehicles, named)
    drives = erased.drives | set(erased_drives)
    prefixes = {name for name in named if any(drive.startswith(f"{name}-") for drive in drives)}
    for column, erased_names in (("vehicle_id", erased.vehicles), ("drive_id", drives | prefixes)):
        if erased_names:
            names = pa.array(sorted(erased_names), pa.string())
            is_erased = pc.is_in(rejected[column].cast(pa.string()), names)
            rejected = rejected.filter(pc.invert(pc.fill_null(is_erased, False)))
    return rejected


# A fingerprint identifies a recording: a digest of a file's bytes, or of a drive's counts. Each is
# a transaction in the commit of the rows, so that two processes that store one drive conflict. The
# version of the transaction is a number that refers to the source without the name of a car.

FILE_PREFIX = "ingest/"
DIGEST_CHARACTERS = 10
_DRIVES, _NUMBERS = 2**20, 2**23
"""Number of drive hashes, and numbers reserved for each digest.

The number of a file is digest * 2^23. The number of a drive is larger by 2^20 plus its hash.
"""

MEASURED = rf"-([0-9a-f]{{{DIGEST_CHARACTERS}}})[0-9a-f]{{2}}((-[0-9]+){{1,2}})$"
"""The end of a measured drive's name: its file's digest, and the number of the drive."""

_MEASURED = re.compile(MEASURED)


class SourceRef(NamedTuple):
    """The source of a recording: the first characters of a file's digest, and a drive's hash.

    The hash is from 1 to 2^20 - 1, and 0 for the whole file.
    """

    digest: str
    drive: int = 0

    @classmethod
    def of_file(cls, digest: str) -> "SourceRef":
        """Return the reference to a file with this digest."""
        return cls(digest[:DIGEST_CHARACTERS])

    @classmethod
    def of_drive(cls, drive_id: str) -> "SourceRef | None":
        """Return the reference to a drive, None if its name is not that of a measured drive."""
        if (match := _MEASURED.search(drive_id)) is None:
            return None
        hashed = int(sha256(match[2].encode()).hexdigest(), 16)
        return cls(match[1], 1 + hashed % (_DRIVES - 1))

    @classmethod
    def of_number(cls, number: int) -> "SourceRef":
        """Return the reference that a fingerprint's number contains."""
        digest, drive = divmod(number, _NUMBERS)
        return cls(f"{digest:0{DIGEST_CHARACTERS}x}", drive % _DRIVES)

    @property
    def number(self) -> int:
        """The number of a fingerprint of this source."""
        return int(self.digest, 16) * _NUMBERS + (_DRIVES + self.drive if self.drive else 0)

    @property
    def file(self) -> "SourceRef":
        """The reference to its file."""
        return SourceRef(self.digest)


def is_from(drive_id: str, sources: Collection[SourceRef]) -> bool:
    """Return True if a drive, or its file, is among the sources."""
    source = SourceRef.of_drive(drive_id)
    return source is not None and (source in sources or source.file in sources)


class Fingerprints:
    """The fingerprints of the stored recordings."""

    def __init__(self, transactions: Named[str, int]) -> None:
        """Take the transactions of a snapshot of the logs."""
        valid = {name: number for name, number in transactions.items() if number != WITHDRAWN}
        self._numbers = {
            name: n for name, n in valid.items() if name.startswith(FINGERPRINT_PREFIX)
        }
        self._files = [name for name in valid if name.startswith(FILE_PREFIX)]

    def find(self, fingerprints: Iterable[str]) -> frozenset[SourceRef]:
        """Return the files and drives with one of the fingerprints."""
        numbers = map(self._numbers.get, fingerprints)
        return frozenset(SourceRef.of_number(number) for number in numbers if number is not None)

    def withdraw(
        self, sources: Collection[SourceRef], files: Collection[SourceRef]
    ) -> list[AppTransaction]:
        """Return the transactions that withdraw `sources`, and the fully removed `files`."""
        of_drives = [
            name
            for name, number in self._numbers.items()
            if (source := SourceRef.of_number(number)) in sources or source.file in files
        ]
        of_files = [
            n for n in self._files if SourceRef.of_file(n.removeprefix(FILE_PREFIX)) in files
        ]
        return [AppTransaction(name, WITHDRAWN) for name in (*of_drives, *of_files)]


def fingerprints_of(drives: Iterable[MeasuredDrive]) -> dict[str, int]:
    """Return the fingerprint of each drive's counts, with the number of its source."""
    sources = ((drive, SourceRef.of_drive(drive.drive_id)) for drive in drives)
    return {
        f"{FINGERPRINT_PREFIX}{drive.counts_digest}": source.number
        for drive, source in sources
        if source
    }


def file_transaction(digest: str) -> AppTransaction:
    """Return the transaction that records a file's content."""
    return AppTransaction(f"{FILE_PREFIX}{digest}", 1)


def combine_digests(digests: Sequence[str]) -> str:
    """Return the digest of several files together."""
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


# A cache of the files of this machine: without it, each run would read all files of a folder to
# find the new ones. The logs decide whether a content is stored.


@dataclass
class IngestCache:
    """The content that files of this machine had when they were ingested with a mapping.

    `entries` contains size in bytes, time of change in ns and digest by absolute path.
    """

    file: Path
    entries: dict[str, tuple[int, int, str]] = field(default_factory=dict)

    @classmethod
    def load(cls, warehouse: Warehouse, mapping: Mapping) -> "IngestCache":
        """Read the cache of a data root and a mapping."""
        about = sha256(f"{warehouse.root.uri}\n{mapping.canonical_json()}".encode()).hexdigest()
        file = cache_folder("ingested") / f"{about[:32]}.json"
        with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            files = json.loads(file.read_bytes())["files"]
            return cls(file, {path: (int(s), int(t), str(d)) for path, (s, t, d) in files.items()})
        return cls(file)

    def find_new_files(self, files: Iterable[Path], warehouse: Warehouse) -> list[Path]:
        """Return the files that are not in the logs, judged by size and time of change."""
        logs = warehouse.logs.snapshot()

        def is_stored(file: Path) -> bool:
            entry = self.entries.get(_absolute_path(file))
            is_unchanged = entry is not None and state_of(file) == entry[:2]
            return entry is not None and is_unchanged and logs.has_committed(FILE_PREFIX + entry[2])

        return [file for file in files if not is_stored(file)]

    def previous_digest(self, file: Path) -> str | None:
        """Return the digest of a path's content when last ingested, None if it never was."""
        entry = self.entries.get(_absolute_path(file))
        return None if entry is None else entry[2]

    def remember(self, file: Path, digest: str) -> None:
        """Record that a file is in the logs."""
        if state := state_of(file):
            self.entries[_absolute_path(file)] = (*state, digest)

    def save(self) -> None:
        """Write the cache; ignores a folder that is not writable."""
        keep_json(self.file, {"files": self.entries})


def _absolute_path(log: Path) -> str:
    return os.path.abspath(log)  # noqa: PTH100 - faster than pathlib


# Files whose recording is stored already.


class Duplicates(NamedTuple):
    """The stored recordings of a file that was read.

    `sources` have its fingerprints, even if their rows were removed. `replaced` are the sources of
    `replaced_drives`, the stored drives that the file replaces.
    """

    sources: frozenset[SourceRef]
    replaced_drives: list[str]
    replaced: frozenset[SourceRef]


def find_duplicates(
    warehouse: Warehouse,
    fingerprints_of_logs: Fingerprints,
    replace: Replace,
    file: Path,
    log: MeasuredLog,
    fingerprints: Named[str, int],
    earlier: str | None,
) -> Duplicates:
    """Return the stored recordings of a file that was read, and the drives that it replaces.

    `earlier` is the digest of the stored content that its path had before. The file replaces all
    drives of a file with the same name, otherwise only the drives with its fingerprints. Raises
    `RepeatedError` for stored drives that `replace` does not permit to replace.
    """
    sources = fingerprints_of_logs.find(fingerprints)
    changed = earlier is not None and earlier != log.digest
    if earlier is not None and changed:
        sources |= {SourceRef.of_file(earlier)}
    stored = stored_drives(warehouse, {source.file for source in sources})
    same = {drive: SourceRef.of_drive(drive) for drive in stored if is_from(drive, sources)}
    replaced = frozenset(
        source.file if source.file in sources or stored[drive] == log.name else source
        for drive, source in same.items()
        if source is not None
    )
    drives = [drive for drive in stored if is_from(drive, replaced)]
    # A correction is the same file, read by another mapping of the same name.
    is_correction = (
        not changed
        and replaced <= {source for source in sources if not source.drive}
        and {re.sub(MEASURED, "", drive) for drive in drives} <= {log.mapping.name}
    )
    may_replace = replace == "all" or (replace == "corrected" and is_correction)
    if drives and not may_replace:
        problem = (
            "it has changed since it was ingested"
            if changed
            else "this recording is in the logs already"
        )
        source_file, more = quote_name(stored[drives[0]]), pluralize(len(drives), "drive")
        names = drives[0] if len(drives) == 1 else f"{more}, {drives[0]} …"
        raise RepeatedError(
            f"{quote_name(file)}: {problem} and would count twice: {names} from {source_file}. "
            "To replace the old one: --replace. To remove it: fleet-slip forget --drive "
            f"{drives[0]}"
        )
    return Duplicates(sources, drives, replaced if drives else frozenset())


def readmit_file(warehouse: Warehouse, digest: str, first_drive: str) -> bool:
    """Withdraw the transactions of a fully erased file whose first drive may return.

    Returns False if it may not. Only drives that were erased by name may return.
    """
    erasure_log = ErasureLog(warehouse.root)
    if (
        not erasure_log.allows_drives
        or erasure_log.state(ErasureSubject("drive", first_drive)) != ALLOWED
    ):
        return False

    def attempt(table: Table) -> None:
        snapshot = table.snapshot()
        if stored_drives(warehouse, {SourceRef.of_file(digest)}):
            return
        if snapshot.has_committed(f"{FILE_PREFIX}{digest}"):
            transactions = (AppTransaction(f"{FILE_PREFIX}{digest}", WITHDRAWN),)
            snapshot.commit(Change(transactions=transactions, note={"job": "undo"}))

    for table in tables_of(warehouse).values():
        retry_conflicts(partial(attempt, table))
    return True


def stored_drives(warehouse: Warehouse, files: Collection[SourceRef]) -> dict[str, str]:
    """Return the stored drives of some files, with their `source_file`."""
    if not files:
        return {}
    query = (
        "SELECT drive_id, source_file FROM drives "
        "WHERE list_contains($digests, regexp_extract(drive_id, $measured, 1)) ORDER BY ALL"
    )
    parameters = {"digests": sorted({file.digest for file in files}), "measured": MEASURED}
    with connect_tables(warehouse, query) as database:
        return dict(database.execute(query, parameters).fetchall())
