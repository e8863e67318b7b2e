"""Lands messages of cars in the table `grams`, once."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.delta import Change, Unit
from fleet_slip.grams.received.new_messages import NewMessages
from fleet_slip.grams.received.received_rows import Refused
from fleet_slip.grams.received.received_table import received_table
from fleet_slip.grams.rows.gram_files import (
    files_to_rewrite,
    is_of_received,
    rows_to_keep,
    write_rows,
)
from fleet_slip.grams.rows.gram_rows import is_received
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, SIGNED, Warehouse

ONE_AT_A_TIME = "receive"
"""Unit that every commit of received rows lands: two at once, which could bring the same message,
are a conflict."""


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
