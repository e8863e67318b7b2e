"""Rollups: the Gram rows of a file added up by what cohorts and folds ask for, in the file itself.

    cells        a table: n, sums and products of the rows that share some columns and a bucket
    vehicles     the hashes of each cell's cars, each once, 8 bytes each
    drives       the hashes of each cell's drives

They stand before the rows (`fleet_slip.delta.encoding`) and go with them. A file has none where it
saves little, a sum has more than 64 bits, or other files tell its trips.
"""

import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Table
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table, list_array
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.warehouse.tables import gram_schema

Hashes = NDArray[np.uint64]
"""Hashes of drives or cars: what tells one from others, in 8 bytes."""

Places = Sequence[tuple[int, int]]
"""Places among the drives of a file: where some begin, and how many these are, in order."""

BUCKETS = 60
"""Drives and cars are dealt into buckets by hashes: folds in a divisor of it are whole ones."""

BUCKET_KEYS = {"drive": "drive_id", "vehicle": "vehicle_id"}
"""What is dealt into buckets, and by which column. Each cell is of one of both."""

ROWS_PER_CELL = 1000
"""A column is rolled up by while so many rows share its value and those of the columns before."""

ALWAYS = ("day", "source", "signals")
"""Columns that every rollup is by; others of a drive if they have few values."""

CELLS, VEHICLES, DRIVES = 0, 1, 2
"""The parts."""

LAYOUT = "1"


def make_rollup(rows: pa.Table, columns: Collection[str] | None = None) -> list[bytes]:
    """Return the parts of a file's rollup, by `columns` or all that conditions name, or none."""
    rows = rows.filter(pc.not_equal(rows["signals"].cast(pa.string()), "")).combine_chunks()
    if len(rows) < ROWS_PER_CELL or not _tells_its_trips(rows):
        return []
    by, cell, first = _cells_of(rows, catalogue().drive if columns is None else columns)
    if not by:
        return []
    told = rows.select(by).take(first)
    told = told.cast(pa.schema([gram_schema(catalogue()).field(name) for name in by]))
    hashes = {key: hash_numbers(rows[name]) for key, name in BUCKET_KEYS.items()}
    tables: list[pa.Table] = []
    members: dict[int, list[Hashes]] = {VEHICLES: [], DRIVES: []}
    [batch] = rows.to_batches()
    for signals, some, here in by_signals(batch):
        grams = gram_table(signals, some)
        for key in BUCKET_KEYS:
            group = cell[here] * BUCKETS + (hashes[key][here] % BUCKETS).astype(np.int64)
            order = np.argsort(group, kind="stable")
            known, starts = np.unique(group[order], return_index=True)
            summed = _sums(grams.take(order), starts)
            if summed is None:
                return []
            cars = [np.unique(h) for h in np.split(hashes["vehicle"][here][order], starts[1:])]
            counts = {
                "key": pa.repeat(key, len(known)),
                "bucket": pa.array(known % BUCKETS),
                "gram_rows": pa.array(np.diff([*starts, len(order)])),
                "cars": pa.array([len(some) for some in cars]),
            }
            of_cells = told.take(pa.array(known // BUCKETS))
            tables.append(pa.table(counts | dict(_columns(of_cells)) | summed))
            if key == "drive":
                members[VEHICLES] += cars
                members[DRIVES].append(hashes["drive"][here][order])
    files = sorted(rows["file"].cast(pa.string()).unique().to_pylist())
    about = {"layout": LAYOUT, "feature_set": str(rows["feature_set"][0]), "files": files}
    cells = pa.concat_tables(tables).replace_schema_metadata({"rollup": json.dumps(about)})
    stored = (np.concatenate(members[part]).astype("<u8").tobytes() for part in (VEHICLES, DRIVES))
    return [_packed(cells), *stored]


@dataclass(frozen=True)
class Rollup:
    """The rollup of a file of Gram rows.

    Attributes:
        table, path: where the file is.
        cells: the cells, and the first of the hashes of each, or those of cells by drive.
        feature_set: identity of the set that its rows are of.
        files: the log files, or files of messages, that its rows are of.
    """

    COUNTS: ClassVar = ("key", "bucket", "gram_rows", "cars", "first_car", "first_drive")

    table: Table
    path: str
    cells: pa.Table
    feature_set: str
    files: frozenset[str]

    @property
    def by(self) -> frozenset[str]:
        """The columns that it is by."""
        return frozenset(self.cells.column_names).difference(self.COUNTS, ("n", "sums", "products"))

    def vehicles(self, cells: pa.Table | None = None) -> Hashes:
        """Return the hashes of the cars of all or some cells; one may be there more than once."""
        if cells is None:
            cells = self.cells.filter(pc.equal(self.cells["key"], "drive"))
        return self._hashes(VEHICLES, cells["first_car"], cells["cars"])

    def drives(self, cells: pa.Table) -> Hashes:
        """Return the hashes of the drives of some cells dealt by drive, one for each Gram row."""
        return self._hashes(DRIVES, cells["first_drive"], cells["gram_rows"])

    def _hashes(self, part: int, first: pa.ChunkedArray, many: pa.ChunkedArray) -> Hashes:
        content = self.table.read_leading_part(self.path, part) or b""
        every = np.frombuffer(content, dtype="<u8").astype(np.uint64)
        begin, size = first.to_numpy(), many.to_numpy()
        if size.sum() == len(every):
            return every
        return np.concatenate([every[a : a + b] for a, b in zip(begin, size, strict=True)])


@dataclass(frozen=True)
class FileDrives:
    """The drives of some cells of a rollup, dealt by drive."""

    rollup: Rollup
    cells: pa.Table

    def __call__(self) -> Hashes:
        """Read their hashes."""
        return self.rollup.drives(self.cells)

    @property
    def places(self) -> Places:
        """Where they stand among the drives of the file."""
        first, many = (self.cells[name].to_pylist() for name in ("first_drive", "gram_rows"))
        return list(zip(first, many, strict=True))


def join_places(every: Places) -> Places:
    """Return places in order, those that border on each other as one."""
    joined: list[tuple[int, int]] = []
    for first, many in sorted(every):
        if joined and sum(joined[-1]) == first:
            joined[-1] = (joined[-1][0], joined[-1][1] + many)
        else:
            joined.append((first, many))
    return joined


def read_rollup(table: Table, path: str) -> Rollup | None:
    """Return a Gram file's rollup; None if unknown or missing. Raises `StorageError` if damaged."""
    content = table.read_leading_part(path, CELLS)
    if content is None:
        return None
    cells, about = _unpacked(content)
    if about["layout"] != LAYOUT:
        return None
    of_drives = np.asarray(pc.equal(cells["key"], "drive").to_numpy(), dtype=np.int64)
    for name, many in (("first_car", "cars"), ("first_drive", "gram_rows")):
        sizes = cells[many].to_numpy() * of_drives
        cells = cells.append_column(name, pa.array(np.cumsum(sizes) - sizes))
    return Rollup(table, path, cells, about["feature_set"], frozenset(about["files"]))


def is_rollup_of(rollup: Rollup, rows: pa.Table) -> bool:
    """Whether a rollup is the sum of the rows of its file."""
    parts = make_rollup(rows, rollup.by)
    if not parts:
        return False
    cells, about = _unpacked(parts[CELLS])
    stored = [rollup.table.read_leading_part(rollup.path, part) for part in (VEHICLES, DRIVES)]
    same = cells.equals(rollup.cells.drop_columns(["first_car", "first_drive"]))
    known = {"feature_set": rollup.feature_set, "files": sorted(rollup.files)}
    return same and about == {"layout": LAYOUT, **known} and parts[VEHICLES:] == stored


def _tells_its_trips(rows: pa.Table) -> bool:
    """Whether each drive is a whole trip, and not a piece of one that goes on in another file."""
    absent = (rows[name].null_count == len(rows) for name in ("part", "trip_id", "started_at"))
    return all(absent) and not any(rows[name].null_count for name in BUCKET_KEYS.values())


def _cells_of(rows: pa.Table, columns: Collection[str]) -> tuple[list[str], IntArray, IntArray]:
    """Return the columns to roll up by, each row's cell, each cell's first row; or no columns."""
    names = {*ALWAYS, *columns}.intersection(rows.column_names)
    codes = {name: _codes(rows[name]) for name in names}
    others = sorted(names.difference(ALWAYS), key=lambda name: (codes[name].max(), name))
    by: list[str] = []
    cell, first = np.zeros(len(rows), dtype=np.int64), np.zeros(1, dtype=np.int64)
    for name in (*ALWAYS, *others):
        both = cell * (codes[name].max() + 1) + codes[name]
        _, at, finer = np.unique(both, return_index=True, return_inverse=True)
        if len(at) * ROWS_PER_CELL <= len(rows):
            cell, first = finer.astype(np.int64), at
            by.append(name)
        elif name in ALWAYS:
            return [], cell, first
    return by, cell, first


def _codes(column: pa.ChunkedArray) -> IntArray:
    """Return a number for each value; equal numbers mean equal bits."""
    values = column.combine_chunks()
    if pa.types.is_floating(values.type):
        values = values.view(pa.int64())
    if not pa.types.is_dictionary(values.type):
        values = values.dictionary_encode()
    codes: IntArray = pc.fill_null(values.indices, -1).to_numpy().astype(np.int64) + 1
    return codes


def _sums(grams: GramTable, starts: IntArray) -> dict[str, pa.Array] | None:
    """Return n, sums and products by group; None where one may have more than 64 bits."""
    largest = int(np.diff([*starts, len(grams)]).max())
    parts = {"n": grams.n[:, None], "sums": grams.sums, "products": grams.products}
    if any(_may_overflow(part, starts, largest) for part in parts.values()):
        return None
    summed = {name: np.add.reduceat(part, starts) for name, part in parts.items()}
    return {
        "n": pa.array(summed["n"][:, 0]),
        **{name: list_array(summed[name]) for name in ("sums", "products")},
    }


def _may_overflow(values: IntArray, begin: IntArray, largest: int) -> bool:
    """Whether a group's sum may need more than 64 bits, by the largest number or a float sum."""
    most = max(int(values.max()), -int(values.min()))
    if most * largest < 2**63:
        return False
    near = np.add.reduceat(np.abs(values.astype(np.float64)), begin)
    return bool(near.max() >= 2.0**62)


def _columns(table: pa.Table) -> Iterator[tuple[str, pa.ChunkedArray]]:
    return zip(table.column_names, table.columns, strict=True)


def _packed(cells: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    with pa.ipc.new_stream(sink, cells.schema, options=options) as writer:
        writer.write_table(cells.combine_chunks())
    return bytes(sink.getvalue())


def _unpacked(content: bytes) -> tuple[pa.Table, dict[str, Any]]:
    with pa.ipc.open_stream(content) as reader:
        cells = reader.read_all()
    return cells.replace_schema_metadata(), json.loads(cells.schema.metadata[b"rollup"])


def hash_numbers(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car, see `Hashes`."""
    first = b"".join([sha256(one.encode("utf-8")).digest()[:8] for one in ids.to_pylist()])
    return np.frombuffer(first, dtype=">u8").astype(np.uint64)
