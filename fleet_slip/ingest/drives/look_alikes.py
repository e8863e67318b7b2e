"""Names that look the same and are not: letters with an accent, as one character or as two."""

import unicodedata
from collections import defaultdict
from collections.abc import Iterable
from typing import TypeAlias

from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse

Groups: TypeAlias = tuple[tuple[str, ...], ...]


def find_look_alikes(names: Iterable[str]) -> Groups:
    """Return the groups of names that differ only in their Unicode form (NFC, NFD)."""
    groups = defaultdict(set)
    for name in names:
        groups[unicodedata.normalize("NFC", name)].add(name)
    return tuple(sorted(tuple(sorted(group)) for group in groups.values() if len(group) > 1))


def find_vehicles_like(
    warehouse: Warehouse, vehicles: Iterable[str]
) -> tuple[tuple[str, ...], ...]:
    """Return the groups of alike names in the logs with one of these; nothing is read for ASCII."""
    suspects = {name for name in vehicles if not name.isascii()}
    if not suspects:
        return ()
    with connect_tables(warehouse, "drives") as database:
        stored = database.sql("SELECT DISTINCT vehicle_id FROM drives").fetchall()
    groups = find_look_alikes({name for (name,) in stored if name is not None} | suspects)
    return tuple(group for group in groups if suspects.intersection(group))
