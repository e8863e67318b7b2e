"""The checks of rows on some long drives of a cohort, read from the logs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

import numpy as np

from fleet_slip.catalog.drive_sources import MEASURED
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.drive_signals import Signals, to_regular_grid
from fleet_slip.quality.plausibility import check_plausibility
from fleet_slip.warehouse.predicate import Predicate, guarded_query
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.warehouse import Warehouse

MAX_TICKS = 100_000
"""Ticks of each drive that are read: a quarter of an hour."""

_LONGEST = """
    SELECT drive_id, vehicle_id, day FROM drives WHERE source = $source AND ({predicate})
    ORDER BY row_number() OVER (PARTITION BY vehicle_id ORDER BY rows DESC, drive_id),
        rows DESC, drive_id
"""


@dataclass(frozen=True)
class InspectedDrive:
    """A drive whose rows were checked, and its faults that do harm."""

    drive_id: str
    vehicle_id: str
    day: date
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class Inspection:
    """Drives whose rows were checked.

    Attributes
    ----------
    drives
        One of each car first, the longest first.
    measured
        Number of measured drives of the cohort.
    """

    drives: tuple[InspectedDrive, ...]
    measured: int

    def by_fault(self) -> dict[tuple[str, tuple[str, ...]], list[Fault]]:
        """Return the faults of all drives by kind and signals."""
        faults: dict[tuple[str, tuple[str, ...]], list[Fault]] = {}
        for drive in self.drives:
            for fault in drive.faults:
                faults.setdefault((fault.kind, fault.signals), []).append(fault)
        return faults

    def is_systematic(self, fault: Fault) -> bool:
        """Return True if most drives have this fault: no drive shows what is right."""
        drives = self.by_fault().get((fault.kind, fault.signals), [])
        return 2 * len(drives) > len(self.drives)


def inspect_drives(
    warehouse: Warehouse,
    predicate: Predicate,
    max_drives: int,
    select: Callable[[Sequence[str]], Sequence[bool]] | None = None,
) -> Inspection:
    """Check the rows of the longest measured drives of a cohort, of as many cars as possible.

    `select` returns which of the drives to consider, by their names.
    """
    signals = warehouse.catalog.signals
    query = _LONGEST.format(predicate=predicate.sql)
    with (
        connect_tables(warehouse, query + "log_counts") as database,
        guarded_query(database, predicate),
    ):
        drives = database.execute(query, {"source": MEASURED}).fetchall()
        measured = len(drives)
        if select is not None:
            selected = select([drive for drive, *_ in drives])
            drives = [drive for drive, use in zip(drives, selected, strict=True) if use]
        inspected = []
        for drive, vehicle, day in drives[:max_drives]:
            columns = database.execute(
                "SELECT * FROM log_counts WHERE day = $day AND drive_id = $drive ORDER BY tick "
                f"LIMIT {MAX_TICKS}",
                {"day": day, "drive": drive},
            ).fetchnumpy()
            faults = check_plausibility(signals, _signals_of(signals, columns))
            harmful = tuple(fault for fault in faults if fault.does_harm)
            inspected.append(InspectedDrive(drive, vehicle, day, harmful))
    return Inspection(tuple(inspected), measured)


def _signals_of(signals: SignalCatalog, columns: Mapping[str, Any]) -> Signals:
    """Return the signals of a drive that have values."""
    counts = {
        name: np.ma.filled(np.ma.asarray(columns[name], dtype=np.float64), np.nan)
        for name in signals.signals
        if name in columns
    }
    present = {name: values for name, values in counts.items() if np.isfinite(values).any()}
    return to_regular_grid(signals, np.asarray(columns["tick"], dtype=np.int32), present)
