"""Keeps out messages of cars and drives that were forgotten.

Names are compared with what was forgotten by slow hashes, and only those of cars that are not known
to be cleared (`fleet_slip.warehouse.cleared_cars`); single drives only of cars that had one
forgotten.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.files.folder import Folder
from fleet_slip.grams.received.received_rows import ReceivedRows, Refused
from fleet_slip.runs.log import LOGGER
from fleet_slip.warehouse.audit import Audit, Barred
from fleet_slip.warehouse.cleared_cars import Cleared, ClearedCars
from fleet_slip.words import number_of

MANY = 500
SECONDS_A_NAME = 0.02
"""On two cores. Of more names than `MANY` it is said before how long that takes."""


@dataclass(frozen=True)
class Screened:
    """Which of some messages are of what was forgotten.

    Attributes:
        barred: cars and drives.
        cleared: cars that were compared now and are none of it.
    """

    barred: Barred = field(default_factory=Barred)
    cleared: Cleared = field(default_factory=Cleared)

    def bars(self, one: Refused) -> bool:
        """Whether a refused message is of what was forgotten."""
        return one.vehicle_id in self.barred.vehicles or one.drive_id in self.barred.drives

    def bars_rows(self, rows: ReceivedRows) -> BoolArray:
        """Return which rows are of what was forgotten."""
        if not self.barred:
            return np.zeros(len(rows), dtype=np.bool_)
        vehicles, drives = (
            pa.array(sorted(names), pa.string())
            for names in (self.barred.vehicles, self.barred.drives)
        )
        found = pc.or_(pc.is_in(rows.vehicle_ids, vehicles), pc.is_in(rows.drive_ids, drives))
        return np.asarray(found.to_numpy(zero_copy_only=False), dtype=np.bool_)

    def remember(self, root: Folder, landed: Sequence[ReceivedRows]) -> None:
        """Keep which of the cars are cleared whose rows have landed."""
        if self.cleared.names:
            cars = self.cleared.names & _cars(landed)
            ClearedCars(root).add(Cleared(self.cleared.entries, cars))


def screen(root: Folder, rows: Sequence[ReceivedRows], refused: Sequence[Refused]) -> Screened:
    """Return which messages are of forgotten cars or drives, and which cars are cleared."""
    audit = Audit(root)
    asked = audit.begun()
    if not asked:
        return Screened()
    cars = _cars(rows) | {one.vehicle_id for one in refused if one.vehicle_id}
    known = ClearedCars(root).read()
    unknown = cars - known.names if known and known.entries >= asked else cars
    if len(unknown) > MANY:
        LOGGER.info(
            "%s that came for the first time are compared with what was forgotten, once: some "
            "%.0f s",
            number_of(len(unknown), "car"),
            len(unknown) * SECONDS_A_NAME,
        )
    watched = audit.with_forgotten_drives(unknown)
    drives = {one.drive_id for one in refused if one.drive_id and one.vehicle_id in watched}
    for some in rows if watched else ():
        mine = pc.is_in(some.vehicle_ids, pa.array(sorted(watched), pa.string()))
        drives.update(some.drive_ids.filter(mine).unique().to_pylist())
    barred = audit.barred(unknown, drives)
    return Screened(barred, Cleared(asked, unknown - watched - barred.vehicles))


def _cars(rows: Sequence[ReceivedRows]) -> frozenset[str]:
    return frozenset(name for some in rows for name in some.vehicle_ids.unique().to_pylist())
