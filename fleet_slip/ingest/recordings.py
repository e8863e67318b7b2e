"""Recognises what is in the logs already, and what was forgotten: neither is loaded again."""

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
from fleet_slip.ingest.drives import MeasuredDrive
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.resources import cache_folder, keep_json
from fleet_slip.storage.table import (
    WITHDRAWN,
    AppTransaction,
    Change,
    Snapshot,
    Table,
    retry_conflicts,
)
from fleet_slip.warehouse.erasure_log import ALLOWED, ErasureLog, ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse, connect_tables

TableName: TypeAlias = Literal["quarantine", "logs"]
Replace: TypeAlias = Literal["no", "corrected", "all"]
"""Which recordings of the logs give way to the same ones: `corrected` are those of the same file
through a mapping of the same name that has changed since."""


def tables_of(warehouse: Warehouse) -> dict[TableName, Table]:
    """Return the tables that files go to, in the order in which they are committed."""
    return {"quarantine": warehouse.quarantine, "logs": warehouse.logs}


# What was forgotten does not come back.


def drop_erased_drives(
    drives: Sequence[MeasuredDrive], erasure_log: ErasureLog
) -> list[MeasuredDrive]:
    """Return the drives that were not forgotten under any name, nor their cars."""
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
    refused: pa.Table, erasure_log: ErasureLog, left_out: Collection[str] = ()
) -> pa.Table:
    """Return the refused rows of what was not forgotten; `left_out` are drives of their file.

    A row goes with its car, or with its drive, whose name begins that of each stretch of it.
    """
    vehicles, named = (
        set(refused[column].unique().drop_null().cast(pa.string()).to_pylist())
        for column in ("vehicle_id", "drive_id")
    )
    erased = erasure_log.erased(vehicles, named)
    drives = erased.drives | set(left_out)
    whole = {name for name in named if any(drive.startswith(f"{name}-") for drive in drives)}
    for column, unwanted in (("vehicle_id", erased.vehicles), ("drive_id", drives | whole)):
        if unwanted:
            names = pa.array(sorted(unwanted), pa.string())
            mine = pc.is_in(refused[column].cast(pa.string()), names)
            refused = refused.filter(pc.invert(pc.fill_null(mine, False)))
    return refused


# Fingerprints recognise a recording: a digest of a file's bytes, or of a drive's counts. Each is a
# transaction in the commit of the rows, so that two processes that load one drive are in conflict.
# Its number says where it is from, and no name of a car follows from it:
#
#     40 bits of the file's digest | 3 bits: 0 of a file | 20 bits of the drive's name

FILES, PREFIX = "ingest/", "same/"
DIGEST_CHARACTERS = 10
_DRIVE_BITS, _KIND_BITS = 20, 3

MEASURED = rf"-([0-9a-f]{{{DIGEST_CHARACTERS}}})[0-9a-f]{{2}}((-[0-9]+){{1,2}})$"
"""What the name of a measured drive ends in: its file's digest, and which drive of it."""

_MEASURED = re.compile(MEASURED)


class SourceRef(NamedTuple):
    """Where a recording is from: the first characters of a file's digest, and a drive's hash or 0.

    0 stands for the whole file.
    """

    digest: str
    drive: int = 0

    @classmethod
    def of(cls, digest: str) -> "SourceRef":
        """Return the origin of a file with this digest."""
        return cls(digest[:DIGEST_CHARACTERS])

    @classmethod
    def of_drive(cls, drive_id: str) -> "SourceRef | None":
        """Return the origin of a drive; None if its name is not that of a measured one."""
        if (found := _MEASURED.search(drive_id)) is None:
            return None
        hashed = int(sha256(found[2].encode()).hexdigest(), 16)
        return cls(found[1], 1 + hashed % (2**_DRIVE_BITS - 1))

    @classmethod
    def of_number(cls, number: int) -> "SourceRef":
        """Return the origin that a fingerprint's number says."""
        digest = number >> (_KIND_BITS + _DRIVE_BITS)
        return cls(f"{digest:0{DIGEST_CHARACTERS}x}", number % 2**_DRIVE_BITS)

    @property
    def number(self) -> int:
        """Number of a fingerprint from here."""
        kind = int(self.drive != 0) << _DRIVE_BITS
        return int(self.digest, 16) << (_KIND_BITS + _DRIVE_BITS) | kind | self.drive

    @property
    def file(self) -> "SourceRef":
        """The file that it is, or is in."""
        return SourceRef(self.digest)


def is_from(drive_id: str, origins: Collection[SourceRef]) -> bool:
    """Whether a drive is one of some, or came in a file of theirs."""
    origin = SourceRef.of_drive(drive_id)
    return origin is not None and (origin in origins or origin.file in origins)


class Fingerprints:
    """The fingerprints of what is in the logs."""

    def __init__(self, transactions: Named[str, int]) -> None:
        """Take the transactions of a snapshot of the logs."""
        there = {name: number for name, number in transactions.items() if number != WITHDRAWN}
        self._numbers = {name: n for name, n in there.items() if name.startswith(PREFIX)}
        self._files = [name for name in there if name.startswith(FILES)]

    def find(self, fingerprints: Iterable[str]) -> frozenset[SourceRef]:
        """Return which files, and which drives of others, have the same fingerprints."""
        numbers = map(self._numbers.get, fingerprints)
        return frozenset(SourceRef.of_number(number) for number in numbers if number is not None)

    def withdraw(
        self, origins: Collection[SourceRef], files: Collection[SourceRef]
    ) -> list[AppTransaction]:
        """Return what withdraws fingerprints of origins, and files themselves that are all gone."""
        of_drives = [
            name
            for name, number in self._numbers.items()
            if (origin := SourceRef.of_number(number)) in origins or origin.file in files
        ]
        of_files = [n for n in self._files if SourceRef.of(n.removeprefix(FILES)) in files]
        return [AppTransaction(name, WITHDRAWN) for name in (*of_drives, *of_files)]


def fingerprints_of(drives: Iterable[MeasuredDrive]) -> dict[str, int]:
    """Return the fingerprint of each drive's counts, and the number of its origin."""
    of = ((drive, SourceRef.of_drive(drive.drive_id)) for drive in drives)
    return {f"{PREFIX}{drive.counts_digest}": origin.number for drive, origin in of if origin}


def file_transaction(digest: str) -> AppTransaction:
    """Return the transaction that a file's content is."""
    return AppTransaction(f"{FILES}{digest}", 1)


def digest_of(digests: Sequence[str]) -> str:
    """Return the digest of several files together."""
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


# Which files of this machine are known: a cache, so that a folder of thousands need not be read to
# find nothing new. Whether their content is in the logs is asked of the logs.


@dataclass
class IngestCache:
    """Which content the files of this machine had when they were ingested through a mapping.

    `digests` has size, time of change and digest by path.
    """

    cache: Path
    digests: dict[str, tuple[int, int, str]] = field(default_factory=dict)

    @classmethod
    def of(cls, warehouse: Warehouse, mapping: Mapping) -> "IngestCache":
        """Return what is remembered for a data root and a mapping."""
        about = sha256(f"{warehouse.root.uri}\n{mapping.canonical_json()}".encode()).hexdigest()
        cache = cache_folder("ingested") / f"{about[:32]}.json"
        with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            files = json.loads(cache.read_bytes())["files"]
            return cls(cache, {path: (int(s), int(t), str(d)) for path, (s, t, d) in files.items()})
        return cls(cache)

    def without_landed(self, files: Iterable[Path], warehouse: Warehouse) -> list[Path]:
        """Return the files that are not in the logs, as far as size and time of change show."""
        landed = warehouse.logs.snapshot().landed_among(len(self.digests))

        def is_there(file: Path) -> bool:
            known = self.digests.get(_name_of(file))
            return known is not None and _state_of(file) == known[:2] and landed(FILES + known[2])

        return [file for file in files if not is_there(file)]

    def digest_of(self, file: Path) -> str | None:
        """Return the digest of what a path had when it was ingested, None if it never was."""
        known = self.digests.get(_name_of(file))
        return None if known is None else known[2]

    def remember(self, file: Path, digest: str) -> None:
        """Keep in mind that a file is in the logs."""
        if state := _state_of(file):
            self.digests[_name_of(file)] = (*state, digest)

    def save(self) -> None:
        """Write the cache; what cannot be written is not kept."""
        keep_json(self.cache, {"files": self.digests})


def _name_of(log: Path) -> str:
    return os.path.abspath(log)  # noqa: PTH100 - the faster


def _state_of(log: Path) -> tuple[int, int] | None:
    """Return size and what changes when the content does; None if that is not known."""
    with suppress(OSError):  # whoever reads it says what is wrong
        found = log.stat()
        return found.st_size, found.st_mtime_ns
    return None


def size_of(log: Path) -> int:
    """Return the bytes of a log, 0 if that is not known."""
    return (_state_of(log) or (0, 0))[0]


# What becomes of a file whose recording is in the logs already.


class DuplicateDetector:
    """Looks for the recordings of a batch of files, in the logs and in the batch."""

    def __init__(
        self, warehouse: Warehouse, logs: Snapshot, mapping: str, replace: Replace
    ) -> None:
        """Take a snapshot of the logs, the mapping's name, and what is to give way."""
        self._warehouse, self._logs = warehouse, logs
        self._mapping, self._replace = mapping, replace
        self._logs_have: Fingerprints | None = None
        self._batch: dict[str, int] = {}
        self._files: dict[str, Path] = {}

    def find(
        self,
        log: Path,
        digest: str,
        fingerprints: Named[str, int],
        name: str,
        earlier: str | None,
    ) -> tuple[frozenset[SourceRef], frozenset[SourceRef], int]:
        """Return what has a file's fingerprints, there or not, what gives way, and how many drives.

        `name` is the file's as `source_file` has it; `earlier` is the digest of what its path had
        before, if that is there. Raises `RepeatedError` for what does not give way to it.
        """
        for origin in Fingerprints(self._batch).find(fingerprints):
            # Another one: the same bytes count once anyway.
            raise RepeatedError(
                f"{quote_name(log)}: same recording as {quote_name(self._files[origin.digest])}. "
                "Leave one "
                "of them out."
            )
        if self._logs_have is None:
            self._logs_have = Fingerprints(self._logs.transactions)
        origins = self._logs_have.find(fingerprints)
        changed = earlier is not None and earlier != digest
        if earlier is not None and changed:
            origins |= {SourceRef.of(earlier)}
        there = _drives_of(self._warehouse, {origin.file for origin in origins})
        replaced = _replaced(there, origins, name)
        drives = [drive for drive in there if is_from(drive, replaced)]
        gives_way = self._replace == "all" or (
            self._replace == "corrected"
            and not changed
            and replaced <= {origin for origin in origins if not origin.drive}
            and {re.sub(MEASURED, "", drive) for drive in drives} <= {self._mapping}
        )
        if drives and not gives_way:
            what = "this recording is in the logs already"
            what = "it has changed since it was ingested" if changed else what
            source, more = quote_name(there[drives[0]]), pluralize(len(drives), "drive")
            such = drives[0] if len(drives) == 1 else f"{more}, {drives[0]} …"
            raise RepeatedError(
                f"{quote_name(log)}: {what} and would count twice: {such} from {source}. To "
                "replace "
                f"the old one: --replace. To remove it: fleet-slip forget --drive {drives[0]}"
            )
        self._batch.update(fingerprints)
        self._files[SourceRef.of(digest).digest] = log
        return origins, replaced if drives else frozenset(), len(drives)


def readmit_file(warehouse: Warehouse, digest: str, first_drive: str) -> bool:
    """Withdraw a file of which no drive is left, and whose first one may come back; say if so.

    Only what was forgotten by a drive's name may: what is too old stays away.
    """
    erasure_log = ErasureLog(warehouse.root)
    if (
        not erasure_log.allows_drives
        or erasure_log.state(ErasureSubject("drive", first_drive)) != ALLOWED
    ):
        return False

    def attempt(table: Table) -> None:
        snapshot = table.snapshot()
        if _drives_of(warehouse, {SourceRef.of(digest)}):
            return
        if snapshot.landed(f"{FILES}{digest}") not in {None, WITHDRAWN}:
            transactions = (AppTransaction(f"{FILES}{digest}", WITHDRAWN),)
            snapshot.commit(Change(transactions=transactions, note={"job": "undo"}))

    for table in tables_of(warehouse).values():
        retry_conflicts(partial(attempt, table))
    return True


def is_fully_erased(warehouse: Warehouse, digest: str) -> bool:
    """Whether drives were forgotten, and none is left of a file that was ingested."""
    return bool(ErasureLog(warehouse.root).entries()) and not _drives_of(
        warehouse, {SourceRef.of(digest)}
    )


def _replaced(
    there: Named[str, str], origins: frozenset[SourceRef], name: str
) -> frozenset[SourceRef]:
    """Return what gives way: of a file of the same name all, else the drives that are the same."""
    same = {drive: SourceRef.of_drive(drive) for drive in there if is_from(drive, origins)}
    return frozenset(
        origin.file if origin.file in origins or there[drive] == name else origin
        for drive, origin in same.items()
        if origin is not None
    )


def _drives_of(warehouse: Warehouse, files: Collection[SourceRef]) -> dict[str, str]:
    """Return the drives that came in some files and are in the logs, and their `source_file`."""
    if not files:
        return {}
    query = (
        "SELECT drive_id, source_file FROM drives "
        "WHERE list_contains($digests, regexp_extract(drive_id, $measured, 1)) ORDER BY ALL"
    )
    given = {"digests": sorted({one.digest for one in files}), "measured": MEASURED}
    with connect_tables(warehouse, query) as database:
        return dict(database.execute(query, given).fetchall())
