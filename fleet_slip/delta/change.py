"""What one commit does to a table, and which units of work land with it."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from typing import Any

from deltalake.transaction import AddAction, RemoveAction

from fleet_slip.delta.encoding import Encoded
from fleet_slip.delta.table_files import TableFile


@dataclass(frozen=True)
class Unit:
    """A piece of work that lands exactly once: its name, and a number that its content determines.

    Recorded as a Delta transaction identifier in the commit that lands it. Two processes that land
    the same unit at once conflict, and one of them is told.
    """

    name: str
    version: int


@dataclass(frozen=True)
class Change:
    """What one commit does to a table.

    A file that is both added and removed stays. `data_change` is false where rows only move
    between files.
    """

    add: Sequence[AddAction] = ()
    remove: Sequence[TableFile] = ()
    units: Sequence[Unit] = ()
    note: Mapping[str, Any] = field(default_factory=dict)
    data_change: bool = True

    def actions(self) -> list[AddAction | RemoveAction]:
        """Return what the commit says to the Delta log, as of now."""
        both = {action.path for action in self.add} & {file.path for file in self.remove}
        return [
            *(action for action in self.add if action.path not in both),
            *(
                _removal(file, data_change=self.data_change)
                for file in self.remove
                if file.path not in both
            ),
        ]


def rows_in(action: AddAction) -> int:
    """Return the number of rows of a file that an action adds."""
    return int(json.loads(action.stats)["numRecords"])


def columns_in(action: AddAction) -> frozenset[str]:
    """Return the columns of a file that an action adds."""
    return frozenset(json.loads(action.stats)["nullCount"])


def addition(path: str, encoded: Encoded, day: date | None) -> AddAction:
    """Return the action that adds a file to a table."""
    return AddAction(
        path=path,
        size=len(encoded.content),
        partition_values=_partition(day),
        modification_time=_now_ms(),
        data_change=True,
        stats=encoded.statistics,
    )


def _removal(file: TableFile, *, data_change: bool) -> RemoveAction:
    return RemoveAction(
        path=file.path,
        data_change=data_change,
        deletion_timestamp=_now_ms(),
        size=file.size_bytes,
        partition_values=_partition(file.day),
    )


def _partition(day: date | None) -> dict[str, str | None]:
    return {"day": day.isoformat()} if day else {}


def _now_ms() -> int:
    return int(time.time() * 1000)
