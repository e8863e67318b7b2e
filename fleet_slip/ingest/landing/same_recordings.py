"""Decides what becomes of a file whose recording is in the logs already."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

from fleet_slip.delta import WITHDRAWN, Change, Snapshot, Table, Unit, retry_conflicts
from fleet_slip.errors import RepeatedError
from fleet_slip.ingest.landing.known_files import WITHDRAWALS
from fleet_slip.ingest.landing.marks import FILES, MEASURED, KnownMarks, Origin
from fleet_slip.ingest.logs.log_files import Log
from fleet_slip.warehouse.audit import ALLOWED, Audit, Forgettable
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of, shown

Replace: TypeAlias = Literal["no", "corrected", "all"]
"""Which recordings that are there give way to the same ones: those of the same file through a
mapping of the same name that has been changed since are `corrected`."""


@dataclass(frozen=True)
class RecordingInLogs:
    """What the logs have of a file's recording.

    Attributes:
        origins: as its marks tell, whether its drives are still there or not.
        replaced: those that give way to it, and how many `drives` that are.
    """

    origins: frozenset[Origin] = frozenset()
    replaced: frozenset[Origin] = frozenset()
    drives: int = 0


class SameRecordings:
    """Looks for the recordings of a batch of files, in the logs and in the batch."""

    def __init__(
        self, warehouse: Warehouse, logs: Snapshot, mapping: str, replace: Replace
    ) -> None:
        """Take a snapshot of the logs, the mapping's name, and what is to give way."""
        self._warehouse, self._logs = warehouse, logs
        self._mapping, self._replace = mapping, replace
        self._batch: dict[str, int] = {}
        self._files: dict[str, Log] = {}

    @cached_property
    def _known(self) -> KnownMarks:
        return KnownMarks(self._logs.units)

    def judge(
        self, file: Log, name: str, digest: str, marks: Mapping[str, int], earlier: str | None
    ) -> RecordingInLogs:
        """Return what the logs have of a file.

        `name` is the file's as `source_file` has it; `earlier` is the digest of what its path had
        before, if that landed. Raises `RepeatedError` for what does not give way to it.
        """
        for origin in KnownMarks(self._batch).find(marks):  # the same bytes count once anyway
            other = shown(self._files[origin.digest])
            raise RepeatedError(
                f"{shown(file)}: it has the recording of {other}, which is ingested with it. "
                "Leave one of them out."
            )
        origins = self._known.find(marks)
        changed = earlier is not None and earlier != digest
        if earlier is not None and changed:
            origins |= {Origin.of(earlier)}
        there = _drives_of(self._warehouse, {one.file for one in origins})
        replaced = _replaced(there, origins, name)
        drives = [drive for drive in there if is_from(drive, replaced)]
        gives_way = self._replace == "all" or (
            self._replace == "corrected"
            and not changed
            and replaced <= {one.file for one in origins} & origins
            and all(drive.startswith(f"{self._mapping}-{_digest(drive)}") for drive in drives)
        )
        if drives and not gives_way:
            raise RepeatedError(_sentence(file, drives, there, changed=changed))
        self._batch.update(marks)
        self._files[Origin.of(digest).digest] = file
        return RecordingInLogs(origins, replaced if drives else frozenset(), len(drives))


def let_return(warehouse: Warehouse, digest: str, first_drive: str) -> bool:
    """Withdraw a file of which no drive is left, and whose first one may come back; say if so.

    Only what was forgotten by a drive's or a file's name may: what is too old stays away.
    """
    audit = Audit(warehouse.root)
    if not audit.allows_drives or audit.state(Forgettable("drive", first_drive)) != ALLOWED:
        return False

    def attempt(table: Table, *others: Unit) -> None:
        snapshot = table.snapshot()
        if _drives_of(warehouse, {Origin.of(digest)}):
            return
        if snapshot.landed(f"{FILES}{digest}") not in {None, WITHDRAWN}:
            units = (Unit(f"{FILES}{digest}", WITHDRAWN), *others)
            snapshot.commit(Change(units=units, note={"job": "undo"}))

    retry_conflicts(lambda: attempt(warehouse.quarantine))
    version = warehouse.logs.snapshot().version or 0
    retry_conflicts(lambda: attempt(warehouse.logs, Unit(WITHDRAWALS, version + 1)))
    return True


def are_gone(warehouse: Warehouse, digest: str) -> bool:
    """Whether drives were forgotten, and none is left that came in a file that has landed."""
    return bool(Audit(warehouse.root).entries()) and not _drives_of(warehouse, {Origin.of(digest)})


def is_from(drive_id: str, origins: Collection[Origin]) -> bool:
    """Whether a drive is one of some, or came in a file of theirs."""
    origin = Origin.of_drive(drive_id)
    return origin is not None and (origin in origins or origin.file in origins)


def _digest(drive_id: str) -> str:
    origin = Origin.of_drive(drive_id)
    return origin.digest if origin else ""


def _replaced(there: Mapping[str, str], origins: frozenset[Origin], name: str) -> frozenset[Origin]:
    """Return what gives way: of a file of the same name all, else the drives that are the same."""
    same = {drive: Origin.of_drive(drive) for drive in there if is_from(drive, origins)}
    return frozenset(
        origin.file if origin.file in origins or there[drive] == name else origin
        for drive, origin in same.items()
        if origin is not None
    )


def _drives_of(warehouse: Warehouse, files: Collection[Origin]) -> dict[str, str]:
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


def _sentence(file: Log, drives: list[str], there: Mapping[str, str], *, changed: bool) -> str:
    """Say what is there of a file, and what to do."""
    source = shown(there[drives[0]])
    what = "it has changed since it was ingested" if changed else "its recording is in the logs"
    such = drives[0] if len(drives) == 1 else f"{number_of(len(drives), 'drive')}, {drives[0]} …"
    return (
        f"{shown(file)}: {what}, and would count twice: {such} from {source}. To put this in its "
        "place, give the command again with --replace; to take the old one out: fleet-slip ingest "
        f"--undo {source}"
    )
