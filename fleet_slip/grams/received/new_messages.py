"""Tells which messages of cars the table `grams` lacks, has or contradicts."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Snapshot, TableFile
from fleet_slip.grams.received.received_rows import ReceivedRows, Refused
from fleet_slip.grams.received.received_table import of_part, received_table
from fleet_slip.grams.received.screening import Screened, screen
from fleet_slip.grams.rows.gram_files import is_of_received
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table, is_received
from fleet_slip.grams.rows.same_drives import content_keys
from fleet_slip.warehouse.tables import SIGNED, Warehouse, gram_schema

CONTRADICTS = "contradicts another message of its drive"
HAS_LOG = "has a drive whose log is here"


@dataclass(frozen=True)
class NewMessages:
    """What lands of some files, given a snapshot of the Gram rows.

    Attributes:
        grams: the snapshot.
        new: rows that it lacks, by their signals.
        refused: what goes to the quarantine.
        superseded: drives whose unsigned rows go, since the key of their car signed others.
        duplicates, forgotten: the file of each row that it has, and that is of a car or a drive
            that was forgotten.
        screened: what of all that was forgotten.
    """

    grams: Snapshot
    new: Sequence[ReceivedRows]
    refused: Sequence[Refused]
    superseded: pa.StringArray
    duplicates: IntArray
    forgotten: IntArray
    screened: Screened


def choose_new(
    warehouse: Warehouse,
    rows: Sequence[ReceivedRows],
    refused: Sequence[Refused],
    *,
    signed: bool = False,
) -> NewMessages:
    """Return what of some rows is new, or contradicts what is there; `signed` ones win."""
    grams = warehouse.grams.snapshot()
    # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
    screened = screen(warehouse.root, rows, refused)
    wrong = [one for one in refused if not screened.bars(one)]
    forgotten = [one.file for one in refused if screened.bars(one)]
    kept = []
    for some in rows:
        out = screened.bars_rows(some)
        forgotten += some.file[out].tolist()
        kept.append(some.take(~out))
    drives = [_Drives.of(some) for some in kept if len(some)]
    _look_up(grams, drives)
    _mark_logged(grams, drives)
    duplicates: list[IntArray] = []
    new: list[ReceivedRows] = []
    superseded = [pa.array([], pa.string())]
    for one in drives:
        fresh, same, logged, beaten = one.compare(signed=signed)
        superseded.append(one.ids.filter(pa.array(beaten)))
        wrong += one.rows.refuse(logged, HAS_LOG)
        wrong += one.rows.refuse(~(fresh | same | logged), CONTRADICTS)
        duplicates.append(one.rows.file[same])
        new += [one.rows.take(fresh)] if fresh.any() else []
    return NewMessages(
        grams,
        new,
        wrong,
        pa.concat_arrays(superseded),
        np.concatenate([*duplicates, np.empty(0, np.int64)]),
        np.array(forgotten, np.int64),
        screened,
    )


@dataclass
class _Drives:
    """Messages of one kind by drive, and what the table already has of each drive.

    Attributes:
        rows: the messages.
        ids: the drives, each once.
        drive: of each message, its place in `ids`.
        first: of each drive, its first message.
        logged: of each drive, whether its log is here.
        known: of a drive, by its place, n, sums and products that the table has.
        signed: of each drive, whether what the table has was signed.
    """

    rows: ReceivedRows
    ids: pa.StringArray
    drive: IntArray
    first: IntArray
    logged: BoolArray
    signed: BoolArray
    known: list[tuple[IntArray, IntArray, IntArray]] = field(default_factory=list)

    @classmethod
    def of(cls, rows: ReceivedRows) -> "_Drives":
        coded = rows.drive_ids.dictionary_encode()
        drive = coded.indices.to_numpy().astype(np.int64)
        _, first = np.unique(drive, return_index=True)
        no = np.zeros(len(first), dtype=np.bool_)
        return cls(rows, coded.dictionary, drive, first, no, no.copy())

    def compare(self, *, signed: bool) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Return which messages are new, which are here already, and which have a log here.

        What is none of these contradicts what is here, or a message before it. And return the
        drives whose unsigned row here gives way to another one that is `signed`.
        """
        logged = self.logged[self.drive]
        there = np.zeros(len(self.ids), dtype=np.bool_)
        same = np.zeros(len(self.rows), dtype=np.bool_)
        at = np.full(len(self.ids), -1, dtype=np.int64)
        for drives, n, numbers in self.known:
            there[drives] = True
            at[drives] = np.arange(len(drives))
            mine = np.flatnonzero(at[self.drive] >= 0)
            its = at[self.drive[mine]]
            same[mine] = self._equal(mine, n[its], numbers[its])
            at[drives] = -1
        beaten = there & ~self.signed & ~self.logged & ~same[self.first] & signed
        there &= ~beaten
        same &= ~beaten[self.drive]
        fresh = np.zeros(len(self.rows), dtype=np.bool_)
        fresh[self.first] = True
        fresh &= ~there[self.drive] & ~logged
        again = np.flatnonzero(~fresh & ~there[self.drive] & ~logged)
        before = self.first[self.drive[again]]
        same[again] = self._equal(again, self.rows.n[before], self.rows.numbers[before])
        return fresh, same & ~logged, logged, beaten

    def _equal(self, mine: IntArray, n: IntArray, numbers: IntArray) -> BoolArray:
        equal = (self.rows.numbers[mine] == numbers).all(axis=1)
        found: BoolArray = equal & (self.rows.n[mine] == n)
        return found


def _look_up(grams: Snapshot, drives: Sequence[_Drives]) -> None:
    """Note for each drive what a snapshot of the Gram rows already has."""
    if not drives:
        return
    wanted = pa.concat_arrays([one.ids for one in drives]).unique()
    identities = {features().identity(PLAIN), *(one.rows.of.identity for one in drives)}
    files = _files_of_days(grams, drives)
    for identity, rows in _rows_with(grams, "drive_id", wanted, files, identities):
        came = is_received(rows)
        logged = rows.filter(pc.invert(came))["drive_id"].cast(pa.string()).unique()
        for one in drives:
            one.logged |= pc.is_in(one.ids, logged).to_numpy(zero_copy_only=False)
            if one.rows.of.identity == identity:
                one.signed |= pc.is_in(one.ids, _signed(rows)).to_numpy(zero_copy_only=False)
        for batch in rows.filter(came).combine_chunks().to_batches():
            for signals, alike, _ in by_signals(batch):
                for one in drives:
                    if one.rows.kind == (identity, signals):
                        one.known += _known(one, signals, of_part(alike, one.rows))


def _signed(rows: pa.Table) -> pa.Array:
    """Return the drives of rows that were signed."""
    if SIGNED not in rows.column_names:
        return pa.array([], pa.string())
    return rows.filter(rows[SIGNED].is_valid())["drive_id"].cast(pa.string()).unique()


def _files_of_days(grams: Snapshot, drives: Sequence[_Drives]) -> list[TableFile]:
    """Return the files that may have the drives: a received one is of the day in its name."""
    days = [limit for one in drives for limit in pc.min_max(one.rows.days).as_py().values()]
    first, last = min(days), max(days)
    return [
        file
        for file in grams.files
        if not (is_of_received(file) and file.days)
        or (file.days[0] <= last and first <= file.days[1])
    ]


def _mark_logged(grams: Snapshot, drives: Sequence[_Drives]) -> None:
    """Note the drives whose car has a log of the same day with the very same Gram row.

    What they sent of other sets is of the same drives.
    """
    if not drives:
        return
    cars = pa.concat_arrays([one.rows.vehicle_ids for one in drives]).unique()
    contents: set[bytes] = set()
    of_logs = [file for file in grams.files if not is_of_received(file)]
    for _, rows in _rows_with(grams, "vehicle_id", cars, of_logs, {features().identity(PLAIN)}):
        contents.update(content_keys(rows.filter(pc.invert(is_received(rows)))))
    found = [pa.array([], pa.string())]
    for one in drives if contents else ():
        if one.rows.is_plain:
            keys = list(content_keys(received_table(one.rows, gram_schema(catalogue()))))
            same = np.array([key in contents for key in keys], dtype=np.bool_)
            found.append(one.ids.take(pa.array(one.drive[same])))
    logged = pa.concat_arrays(found).unique()
    for one in drives if len(logged) else ():
        one.logged |= pc.is_in(one.ids, logged).to_numpy(zero_copy_only=False)


def _known(
    one: _Drives, signals: str, rows: pa.RecordBatch
) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
    """Yield where drives stand, and their n and numbers in the table."""
    places = pc.index_in(rows["drive_id"].cast(pa.string()), one.ids)
    if places.null_count == len(places):
        return
    mine = rows.filter(places.is_valid())
    if not signals:
        numbers = np.empty((len(mine), 0), np.int64)
    else:
        table = gram_table(signals, mine)
        numbers = np.hstack([table.sums, table.products])
    at = places.drop_null().to_numpy().astype(np.int64)
    yield at, mine["n"].to_numpy(), numbers


def _rows_with(
    grams: Snapshot,
    column: str,
    names: pa.StringArray,
    files: Sequence[TableFile],
    identities: Collection[str],
) -> Iterator[tuple[str, pa.Table]]:
    """Yield the Gram rows that some files have of some sets, and of some drives or cars."""
    for file in files:
        rows = grams.table.read(file.path, ["feature_set", column])
        there = pc.is_in(rows[column].cast(pa.string()), names)
        for identity in identities:
            mine = pc.and_(pc.equal(rows["feature_set"], identity), there)
            if pc.any(mine).as_py():
                yield identity, grams.table.read(file.path).filter(mine)
