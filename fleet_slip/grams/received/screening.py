"""Keeps out messages of cars and drives that were forgotten."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.files.folder import Folder
from fleet_slip.grams.received.received_rows import ReceivedRows, Refused
from fleet_slip.warehouse.audit import Audit, Barred


@dataclass(frozen=True)
class Screened:
    """Which of some messages are of what was forgotten."""

    barred: Barred = field(default_factory=Barred)

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


def screen(root: Folder, rows: Sequence[ReceivedRows], refused: Sequence[Refused]) -> Screened:
    """Return which messages are of forgotten cars or drives."""
    cars = {one.vehicle_id for one in refused if one.vehicle_id}
    drives = {one.drive_id for one in refused if one.drive_id}
    for some in rows:
        cars.update(some.vehicle_ids.unique().to_pylist())
        drives.update(some.drive_ids.unique().to_pylist())
    return Screened(Audit(root).barred(cars, drives))
