"""Takes in messages of cars that send Gram rows: rows without a log, beside those with one.

A received Gram row names no log file but `received/` and a digest of the file of messages that
brought it; its drive has the source `received`. A file of messages lands once. So does a message:
the same one again is a duplicate, another one of the same drive is refused. What is refused goes to
the quarantine with the reason, first. Files land many at once, in one commit.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.config import read_named_file
from fleet_slip.delta import Change, Unit, retry_conflicts
from fleet_slip.errors import InputError
from fleet_slip.grams.received.car_keys import load_car_keys
from fleet_slip.grams.received.found_messages import read_messages
from fleet_slip.grams.received.new_messages import NewMessages, choose_new
from fleet_slip.grams.received.received_rows import Refused
from fleet_slip.grams.received.received_table import received_table
from fleet_slip.grams.received.signatures import judge_signatures
from fleet_slip.grams.received.sound_messages import sort_out
from fleet_slip.grams.rows.gram_files import (
    files_to_rewrite,
    is_of_received,
    rows_to_keep,
    write_rows,
)
from fleet_slip.grams.rows.gram_rows import is_received
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, SIGNED, Warehouse
from fleet_slip.words import number_of

ONE_AT_A_TIME = "receive"
"""Unit that every commit of received rows lands: two at once, which could bring the same message,
are a conflict."""

LARGEST_FILE_BYTES = 2**28
BATCH_BYTES = 2**26
"""Files of so many bytes together land in one commit: some 100,000 messages."""


@dataclass(frozen=True)
class MessageFile:
    """A file of messages: its name, the digest of its content, and the unit that it lands as."""

    name: str
    digest: str

    @property
    def unit(self) -> Unit:
        """The unit of work under which the file lands, once."""
        return Unit(f"receive/{self.digest}", 1)


def land_refused(
    warehouse: Warehouse, files: Sequence[MessageFile], refused: Sequence[Refused]
) -> None:
    """Commit what was refused of some files to the quarantine, once."""
    snapshot = warehouse.quarantine.snapshot()
    waiting = {
        at for at in {one.file for one in refused} if snapshot.landed(files[at].unit.name) is None
    }
    some = sorted(
        (one for one in refused if one.file in waiting), key=lambda one: (one.file, one.number)
    )
    if not some:
        return
    columns: dict[str, list[Any]] = {
        "file": [files[one.file].name for one in some],
        "row": [one.number for one in some],
        "drive_id": [one.drive_id for one in some],
        "vehicle_id": [one.vehicle_id for one in some],
        "reason": [f"the message {one.reason}" for one in some],
    }
    absent = {name: [None] * len(some) for name in ("signal", "value")}
    rows = pa.table({**columns, **absent}, schema=QUARANTINE_SCHEMA)
    units = [files[at].unit for at in sorted(waiting)]
    action = warehouse.quarantine.write_file(units[0].name.replace("/", "-")[:40], rows)
    snapshot.commit_or_discard(Change(add=[action], units=units, note={"job": "receive"}))


def land_rows(warehouse: Warehouse, files: Sequence[MessageFile], new: NewMessages) -> None:
    """Commit the new rows of some files, and mark these files as landed."""
    grams = new.grams
    replaced = files_to_rewrite(grams, frozenset()) if new.new else []
    if len(new.superseded):
        replaced += [
            file
            for file in filter(is_of_received, grams.files)
            if file not in replaced and _is_superseded(grams.table.read(file.path), new).any()
        ]
    kept = (
        rows.filter(pa.array(~_is_superseded(rows, new)))
        for rows in rows_to_keep(grams, replaced, frozenset())
    )
    mine = [
        received_table(rows, warehouse.grams.schema, [file.digest for file in files])
        for rows in new.new
    ]
    single = Unit(ONE_AT_A_TIME, (grams.version or 0) + 1)
    grams.commit_or_discard(
        Change(
            add=write_rows(warehouse, chain(kept, mine)),
            remove=replaced,
            units=[*(file.unit for file in files), single],
            note={"job": "receive"},
        )
    )


def _is_superseded(rows: pa.Table, new: NewMessages) -> BoolArray:
    """Return which rows of `grams` give way to signed ones."""
    out = pc.and_(is_received(rows), pc.is_in(rows["drive_id"].cast(pa.string()), new.superseded))
    if SIGNED in rows.column_names:
        out = pc.and_(out, rows[SIGNED].is_null())
    return np.asarray(out.to_numpy(zero_copy_only=False), dtype=np.bool_)


@dataclass
class ReceiveReport:
    """What became of a file of messages.

    Attributes:
        file: its path.
        new: whether it had not landed before.
        messages: in it, the refused ones included.
        received: Gram rows that landed.
        rows: of drives, in these.
        duplicates: messages that had landed.
        forgotten: messages of cars or drives that were forgotten: left out.
        refused: how many messages went to the quarantine, by reason.
    """

    file: str
    new: bool = True
    messages: int = 0
    received: int = 0
    rows: int = 0
    duplicates: int = 0
    forgotten: int = 0
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def is_useless(self) -> bool:
        """Whether all of a new file was refused."""
        return self.new and bool(self.refused) and sum(self.refused.values()) >= self.messages

    def as_dict(self) -> dict[str, Any]:
        """Return what `receive --json` prints."""
        return vars(self) | {"refused": dict(self.refused)}


def receive_files(
    warehouse: Warehouse, files: Sequence[Path], progress: Progress = no_progress
) -> Iterator[ReceiveReport]:
    """Take in files of messages; yield a report of each once it has landed.

    `progress` counts files. Raises `InputError` for files that cannot be read, once the others have
    landed; `StorageError`; and `ConflictError` if other processes keep changing the tables.
    """
    load_car_keys()  # a list that cannot be read is told, though all files may have landed
    batch: dict[Path, bytes] = {}
    failures: list[str] = []
    for at, path in enumerate(files):
        try:
            batch[path] = _read(path)
        except InputError as error:
            failures.append(str(error))
        full = sum(map(len, batch.values())) >= BATCH_BYTES
        if batch and (full or at + 1 == len(files)):
            yield from _receive_batch(warehouse, batch)
            progress(len(batch), len(files))
            batch = {}
    if failures:
        others = number_of(len(failures) - 1, "other file")
        more = f" Nor can {others} be read: {' '.join(failures[1:4])}" if failures[1:] else ""
        raise InputError(f"{failures[0]}{more}")


def find_messages(given: Iterable[Path]) -> list[Path]:
    """Return files, and all below folders, sorted by name. Raises `InputError` without any."""
    found: list[Path] = []
    for path in given:
        inside = sorted(one for one in path.rglob("*") if one.is_file()) if path.is_dir() else []
        if not inside and not path.is_file():
            raise InputError(f"{path}: is no file of messages, and no folder that has some.")
        found += inside or [path]
    return found


def _receive_batch(warehouse: Warehouse, batch: dict[Path, bytes]) -> list[ReceiveReport]:
    """Land files in one commit; return the report of each."""
    snapshot = warehouse.grams.snapshot()
    reports = {path: ReceiveReport(str(path), new=False) for path in batch}
    files: list[MessageFile] = []
    fresh: list[ReceiveReport] = []
    found = []
    for path, content in batch.items():
        file = MessageFile(path.name, hashlib.sha256(content).hexdigest())
        known = any(one.digest == file.digest for one in files)
        if not known and snapshot.landed(file.unit.name) is None:
            reports[path].new = True
            found.append((len(files), read_messages(content)))
            files.append(file)
            fresh.append(reports[path])
    if not files:
        return list(reports.values())
    keys = load_car_keys()
    rows, refused = sort_out(found, None if keys is None else partial(judge_signatures, keys=keys))

    def attempt() -> NewMessages:
        new = choose_new(warehouse, rows, refused, signed=keys is not None)
        land_refused(warehouse, files, new.refused)
        land_rows(warehouse, files, new)
        return new

    new = retry_conflicts(attempt)
    for report, (_, one) in zip(fresh, found, strict=True):
        report.messages = one.count
    _tell(fresh, new)
    return list(reports.values())


def _tell(reports: Sequence[ReceiveReport], new: NewMessages) -> None:
    """Count in the report of each file what landed of it."""
    for one in new.refused:
        reports[one.file].refused[one.reason] += 1
    for rows in new.new:
        for at in np.unique(rows.file).tolist():
            mine = rows.file == at
            reports[at].received += int(mine.sum())
            reports[at].rows += int(rows.n[mine].sum())
    for at in new.duplicates.tolist():
        reports[at].duplicates += 1
    for at in new.forgotten.tolist():
        reports[at].forgotten += 1


def _read(path: Path) -> bytes:
    content = read_named_file(path, LARGEST_FILE_BYTES, InputError)
    if not content:
        raise InputError(f"{path}: is empty.")
    return content
