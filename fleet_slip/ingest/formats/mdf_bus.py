"""Reads the CAN frames that a logger stored in an MDF 4 file (bus logging), through a database.

ASAM's associated standard names the channels: a group of frames has `CAN_DataFrame.ID` and others.
"""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.can.can_bus import CanBus, parse_database
from fleet_slip.ingest.formats.can.can_frames import Bytes, FrameBlock
from fleet_slip.ingest.formats.can.can_trace import CanSource
from fleet_slip.ingest.formats.mdf import MdfSource, open_mdf
from fleet_slip.ingest.logs.spool import Spool
from fleet_slip.words import shown

_FRAME = "CAN_DataFrame."
_EXTENDED = 1 << 31
"""Bit that marks an identifier of 29 bits, where no channel of its own does."""
_IDENTIFIER = (1 << 29) - 1


class MdfBus(CanSource):
    """The CAN messages of an MDF file."""

    def __init__(
        self, bus: CanBus, database: Any, spool: Spool, budget: Budget, mdf: MdfSource
    ) -> None:
        """Take what a trace does, and the open file."""
        super().__init__(bus, database, spool, budget)
        self._mdf = mdf

    def _read_trace(self) -> None:
        """Keep the frames of the wanted messages, and note the numbers of all."""
        groups = [*self._mdf.groups_with(f"{_FRAME}ID")]
        frames, passed = sum(self._mdf.count_records(number) for number, _ in groups), 0
        for number, places in groups:
            names = ("ID", "DataBytes", "DataLength", "IDE", "BusChannel")
            there = {n: places[_FRAME + n] for n in names if _FRAME + n in places}
            if "DataBytes" not in there:
                raise InputError(
                    f"{shown(self._file)}: group {number} has frames without {_FRAME}DataBytes. "
                    "Export it again, with payloads."
                )
            for window in self._mdf.windows(number, there):
                self._keep(self._block(dict(zip(there, window, strict=True))))
                passed += len(window[0])
                self._budget.meter.pass_over(passed, frames)
        if not self._numbers:
            raise InputError(
                f"{shown(self._file)}: there is no CAN frame in it ({_FRAME}ID). Map its channels "
                "without [can] in the mapping."
            )

    def _block(self, found: dict[str, Any]) -> FrameBlock:
        """Return some frames of a group."""
        numbers = found["ID"].samples.astype(np.int64)
        extended = numbers & _EXTENDED != 0
        if "IDE" in found:
            extended |= found["IDE"].samples.astype(np.int64) != 0
        payloads = _payloads(found["DataBytes"].samples)
        sizes = np.full(len(numbers), payloads.shape[1])
        if "DataLength" in found:
            sizes = np.minimum(sizes, found["DataLength"].samples.astype(np.int64))
        buses = np.zeros(len(numbers), dtype=np.int64)
        if "BusChannel" in found:
            buses = found["BusChannel"].samples.astype(np.int64)
        times_s = self._mdf.times_s(found["ID"])
        return FrameBlock(numbers & _IDENTIFIER, extended, times_s, buses, sizes, payloads)


def _payloads(samples: NDArray[Any]) -> Bytes:
    """Return payloads as a matrix of bytes, those that are shorter filled up."""
    if samples.ndim > 1:
        return samples.astype(np.uint8, copy=False)
    found = np.asarray(samples, dtype="S64" if samples.dtype.kind == "O" else samples.dtype)
    return np.ascontiguousarray(found).view(np.uint8).reshape(len(found), -1)


@contextmanager
def open_mdf_bus(bus: CanBus, budget: Budget) -> Iterator[MdfBus]:
    """Open an MDF file for the CAN frames in it. Raises `InputError`."""
    database = parse_database(bus)
    with closing(Spool()) as spool, open_mdf(budget) as mdf:
        yield MdfBus(bus, database, spool, budget, mdf)
