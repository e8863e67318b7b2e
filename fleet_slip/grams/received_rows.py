"""Received Gram rows in the tables: which of them are new, and landing them, once."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.delta import Change, Snapshot, Unit
from fleet_slip.grams.gram_files import files_to_rewrite, rows_to_keep, write_rows
from fleet_slip.grams.gram_rows import by_signals
from fleet_slip.grams.messages import Message
from fleet_slip.regression.gram import packed_size
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, Warehouse

ONE_AT_A_TIME = "receive"
"""Unit that every commit of received rows lands: two at once, which could bring the same message,
are a conflict."""


@dataclass(frozen=True)
class Refused:
    """A message that does not land: its number in the file, why, and its drive and car if known."""

    number: int
    reason: str
    drive_id: str | None = None
    vehicle_id: str | None = None


class ReceivedRow(NamedTuple):
    """A message that may land: its number in the file, and what the table says of it."""

    number: int
    message: Message
    vehicle_id: str
    drive_id: str
    day: date

    def refuse(self, reason: str) -> Refused:
        """Return it as refused."""
        return Refused(self.number, reason, self.drive_id, self.vehicle_id)


@dataclass(frozen=True)
class Landing:
    """What of a file lands on a snapshot of the Gram rows.

    Attributes:
        grams: the snapshot.
        new: rows that it lacks.
        refused: what goes to the quarantine.
        duplicates, forgotten: how many rows it has, and of cars or drives that were forgotten.
    """

    grams: Snapshot
    new: Sequence[ReceivedRow]
    refused: Sequence[Refused]
    duplicates: int
    forgotten: int


@cache
def signals_of(mask: int) -> str:
    """Return the names of a message's signals, as the table `grams` has them."""
    return ",".join(n for i, n in enumerate(catalogue().gram_signals) if mask >> i & 1)


def by_mask(rows: Iterable[ReceivedRow]) -> dict[int, list[ReceivedRow]]:
    """Return rows by the signals that they are of."""
    found: dict[int, list[ReceivedRow]] = {}
    for row in rows:
        found.setdefault(row.message.mask, []).append(row)
    return found


def arrays_of(rows: Sequence[ReceivedRow]) -> tuple[Any, Any, Any]:
    """Return n, sums and products of rows of the same signals, shapes (m,), (m, k), (m, p)."""
    k = rows[0].message.mask.bit_count()
    numbers = np.frombuffer(b"".join(row.message.numbers for row in rows), "<i8")
    numbers = numbers.reshape(len(rows), k + packed_size(k))
    n = np.array([row.message.rows for row in rows], np.int64)
    return n, numbers[:, :k], numbers[:, k:]


def choose_rows(
    warehouse: Warehouse, rows: Sequence[ReceivedRow], refused: Sequence[Refused]
) -> Landing:
    """Return what of some rows is new, and what contradicts what is there."""
    grams = warehouse.grams.snapshot()
    # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
    named: list[ReceivedRow | Refused] = [*rows, *refused]
    barred = Audit(warehouse.root).barred(
        {one.vehicle_id for one in named if one.vehicle_id},
        {one.drive_id for one in named if one.drive_id},
    )

    def allowed(one: ReceivedRow | Refused) -> bool:
        return one.vehicle_id not in barred.vehicles and one.drive_id not in barred.drives

    kept = [row for row in rows if allowed(row)]
    known, logged = _known_rows(grams, {row.drive_id for row in kept})
    new: list[ReceivedRow] = []
    wrong = [one for one in refused if allowed(one)]
    forgotten = len(named) - len(kept) - len(wrong)
    for row in kept:
        key = row.drive_id, signals_of(row.message.mask)
        numbers = row.message.rows, row.message.numbers
        if row.drive_id in logged:
            wrong.append(row.refuse("has a drive whose log is here"))
        elif key not in known:
            known[key] = numbers
            new.append(row)
        elif known[key] != numbers:
            wrong.append(row.refuse("contradicts another message of its drive"))
    duplicates = len(kept) + len(refused) - sum(not allowed(one) for one in refused)
    duplicates -= len(new) + len(wrong)
    return Landing(grams, new, wrong, duplicates, forgotten)


def _known_rows(
    grams: Snapshot, drives: Collection[str]
) -> tuple[dict[tuple[str, str], tuple[int, bytes]], set[str]]:
    """Return received rows of some drives, by drive and signals, and the drives with a log."""
    wanted = pa.array(sorted(drives), pa.string())
    known: dict[tuple[str, str], tuple[int, bytes]] = {}
    logged: set[str] = set()
    for file in grams.files if drives else ():
        rows = grams.table.read(file.path, ["feature_set", "file", "drive_id"])
        plain = pc.equal(rows["feature_set"], features().identity(PLAIN))
        mine = pc.and_(plain, pc.is_in(rows["drive_id"].cast(pa.string()), wanted))
        if not pc.any(mine).as_py():
            continue
        every = grams.table.read(file.path).filter(mine)
        came = is_received(every)
        logged.update(every.filter(pc.invert(came))["drive_id"].to_pylist())
        for batch in every.filter(came).combine_chunks().to_batches():
            known |= _numbers_of(batch)
    return known, logged


def _numbers_of(batch: pa.RecordBatch) -> dict[tuple[str, str], tuple[int, bytes]]:
    """Return n, and sums and products as messages have them, of Gram rows by drive and signals."""
    found: dict[tuple[str, str], tuple[int, bytes]] = {}
    for signals, rows, _ in by_signals(batch):
        k = len([name for name in signals.split(",") if name])
        sums = rows["sums"].flatten().to_numpy().reshape(-1, k)
        products = rows["products"].flatten().to_numpy().reshape(-1, packed_size(k))
        numbers = np.hstack([sums, products]).astype("<i8")
        size, content = numbers.shape[1] * 8, numbers.tobytes()
        drives, counts = rows["drive_id"].to_pylist(), rows["n"].to_pylist()
        for i, (drive, n) in enumerate(zip(drives, counts, strict=True)):
            found[drive, signals] = (n, content[i * size : (i + 1) * size])
    return found


def is_received(rows: pa.Table) -> pa.ChunkedArray:
    """Return which rows of `grams` came without a log."""
    return pc.starts_with(rows["file"].cast(pa.string()), RECEIVED_FILES)


def land_refused(warehouse: Warehouse, file: str, unit: Unit, refused: Sequence[Refused]) -> None:
    """Commit what was refused of a file to the quarantine, once."""
    snapshot = warehouse.quarantine.snapshot()
    if not refused or snapshot.landed(unit.name) is not None:
        return
    ordered = sorted(refused, key=lambda one: one.number)
    columns: dict[str, list[Any]] = {
        "file": [file] * len(ordered),
        "row": [one.number for one in ordered],
        "drive_id": [one.drive_id for one in ordered],
        "vehicle_id": [one.vehicle_id for one in ordered],
        "reason": [f"the message {one.reason}" for one in ordered],
    }
    absent = {name: [None] * len(ordered) for name in ("signal", "value")}
    rows = pa.table({**columns, **absent}, schema=QUARANTINE_SCHEMA)
    action = warehouse.quarantine.write_file(unit.name.replace("/", "-")[:40], rows)
    snapshot.commit_or_discard(Change(add=[action], units=[unit], note={"job": "receive"}))


def land_rows(warehouse: Warehouse, digest: str, unit: Unit, landing: Landing) -> None:
    """Commit the new rows of a file, and that it landed."""
    grams = landing.grams
    if grams.landed(unit.name) is not None:
        return
    replaced = files_to_rewrite(grams, frozenset()) if landing.new else []
    kept = rows_to_keep(grams, replaced, frozenset())
    mine = [_table(warehouse, digest, some) for some in by_mask(landing.new).values()]
    single = Unit(ONE_AT_A_TIME, (grams.version or 0) + 1)
    grams.commit_or_discard(
        Change(
            add=write_rows(warehouse, chain(kept, mine)),
            remove=replaced,
            units=[unit, single],
            note={"job": "receive"},
        )
    )


def _table(warehouse: Warehouse, digest: str, rows: Sequence[ReceivedRow]) -> pa.Table:
    """Return rows of the same signals in the schema of `grams`."""
    schema = warehouse.grams.schema
    n, sums, products = arrays_of(rows)
    known: dict[str, Any] = {
        "feature_set": pa.repeat(features().identity(PLAIN), len(rows)),
        "file": pa.repeat(f"{RECEIVED_FILES}{digest[:24]}", len(rows)),
        "day": pa.array([row.day for row in rows], pa.date32()),
        "drive_id": pa.array([row.drive_id for row in rows]),
        "vehicle_id": pa.array([row.vehicle_id for row in rows]),
        "source": pa.repeat(RECEIVED, len(rows)),
        "signals": pa.repeat(signals_of(rows[0].message.mask), len(rows)),
        "n": pa.array(n),
        "clipped": pa.repeat(0, len(rows)),
        "sums": _lists(sums),
        "products": _lists(products),
    }
    return pa.table(
        {
            one.name: known[one.name].cast(one.type)
            if one.name in known
            else pa.nulls(len(rows), one.type)
            for one in schema
        },
        schema=schema,
    )


def _lists(values: Any) -> pa.Array:
    rows, width = values.shape
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), pa.int64())
    offsets = pa.array(np.arange(rows + 1, dtype=np.int32) * width, pa.int32())
    return pa.ListArray.from_arrays(offsets, flat)
