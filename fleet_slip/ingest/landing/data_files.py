"""Writes rows of measured files to data files of bounded size. Nothing is committed."""

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Literal, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.delta import Table, Unit
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.landing.log_table import log_table
from fleet_slip.ingest.mapping.mapping import Mapping

FILE_ROWS = 2**18
"""A data file is written as soon as it has so many rows; its last drive may make it larger."""

WRITERS = 2
"""Data files that are written at once: encoding them is the longest part of an ingest."""

TableName: TypeAlias = Literal["quarantine", "logs"]
Rows: TypeAlias = Sequence[MeasuredDrive] | Sequence[pa.Table]
"""Drives for the logs, or refused rows for the quarantine."""
Writing: TypeAlias = Future[list[AddAction]]


@dataclass(frozen=True)
class Part:
    """Data files of one table that are not committed yet, and the units that land with them."""

    units: tuple[Unit, ...]
    files: tuple[AddAction, ...]


def unit_of(digest: str) -> Unit:
    """Return the unit of work that a file's content is."""
    return Unit(f"ingest/{digest}", 1)


def digest_of(digests: Sequence[str]) -> str:
    """Return the digest of several files together."""
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


class DataFiles:
    """Data files of one table that a batch of measured files becomes, written by threads."""

    def __init__(
        self,
        table: Table,
        mapping: Mapping,
        threads: ThreadPoolExecutor,
        landed: Callable[[str], bool],
    ) -> None:
        """Take the table, the files' mapping, the threads, and what tells which units it has."""
        self._table, self._mapping, self._threads, self._landed = table, mapping, threads, landed
        self._begun: list[Writing] = []
        self._of_one: list[Writing] = []
        self._of_several: list[Writing] = []
        self._waiting: dict[str, Rows] = {}
        self._digests: list[str] = []

    def lacks(self, digest: str) -> bool:
        """Whether a file's rows are neither in the table nor about to be."""
        return digest not in self._digests and not self._landed(unit_of(digest).name)

    def write(self, name: str, rows: Rows) -> Writing:
        """Write rows while the caller goes on; at most `WRITERS` files are under way."""
        if len(self._begun) >= WRITERS:
            self._begun[-WRITERS].result()
        self._begun.append(self._threads.submit(self._write, name, rows))
        return self._begun[-1]

    def take(self, digest: str, own: Sequence[Writing], rest: Rows) -> None:
        """Take what a file became: data files of its own, and rows that wait for those of others.

        These are the rows of a small file, or the last of a large one.
        """
        if own or rest:
            self._digests.append(digest)
        self._of_one += own
        if rest:
            self._waiting[digest] = rest
        if sum(one.num_rows for rows in self._waiting.values() for one in rows) >= FILE_ROWS:
            self.write_waiting()

    def write_waiting(self) -> None:
        """Write rows in the order of their files' digests, and so of the names of drives."""
        digests = sorted(self._waiting)
        if digests:
            rows: Any = [one for digest in digests for one in self._waiting[digest]]
            name = f"measured-{digest_of(digests)[:24]}"
            self._of_several.append(self.write(name, rows))
            self._waiting = {}

    def finish(self) -> Part:
        """Return all data files, written, and the units that they are."""
        self.write_waiting()
        writings = (*self._of_one, *self._of_several)
        files = tuple(file for writing in writings for file in writing.result())
        return Part(tuple(map(unit_of, sorted(self._digests))), files)

    def discard(self, own: Collection[Writing]) -> None:
        """Delete data files of a file that turned out not to be usable."""
        written = [writing for writing in own if writing.exception() is None]
        self._table.discard(file for writing in written for file in writing.result())

    def _write(self, name: str, rows: Rows) -> list[AddAction]:
        parts = _by_day(_as_table(rows, self._mapping))
        encoded = {day: self._table.encode(part) for day, part in parts.items()}
        del parts  # a disk may take its time
        return [self._table.put(name, content, day) for day, content in encoded.items()]


def _as_table(rows: Rows, mapping: Mapping) -> pa.Table:
    """Return rows in one table."""
    tables = [one for one in rows if isinstance(one, pa.Table)]
    if tables:
        return pa.concat_tables(tables).unify_dictionaries()
    return log_table([one for one in rows if isinstance(one, MeasuredDrive)], mapping)


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    """Return the rows of each day; refused ones, which are not kept by day, as they are."""
    if "day" not in rows.column_names:
        return {None: rows}
    days = rows["day"].unique().to_pylist()
    if len(days) == 1:
        return {days[0]: rows}
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}
