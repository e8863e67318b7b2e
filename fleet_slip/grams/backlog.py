"""How the tables `logs` and `grams` differ."""

from dataclasses import dataclass

import pyarrow.compute as pc

from fleet_slip.catalogue.features import PLAIN
from fleet_slip.delta import (
    Snapshot,
    TableFile,
)


@dataclass(frozen=True)
class Backlog:
    """How `grams` and `logs` differ."""

    missing: tuple[TableFile, ...]
    """Log files without Gram rows of the feature set."""
    stale: frozenset[str]
    """Paths in `grams`, of any set, that are no active log file."""


def find_backlog(logs: Snapshot, grams: Snapshot, identity: str = PLAIN) -> Backlog:
    """Compare the active log files with the files that Gram rows name.

    `identity` is that of a feature set, as its Gram rows carry it.
    """
    done: set[str] = set()
    named: set[str] = set()
    for file in grams.files:
        rows = grams.table.read(file.path, ["feature_set", "file"])
        named.update(rows["file"].unique().to_pylist())
        mine = rows.filter(pc.equal(rows["feature_set"], identity))
        done.update(mine["file"].unique().to_pylist())
    active = {file.path for file in logs.files}
    return Backlog(
        missing=tuple(file for file in logs.files if file.path not in done),
        stale=frozenset(named - active),
    )
