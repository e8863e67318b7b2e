"""Reads the CAN frames that a logger stored in an MDF 4 file (bus logging), through a database.

ASAM's associated standard names the channels: a group of frames has `CAN_DataFrame.ID` and others.
"""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fleet_slip.errors import InputError
from fleet_slip.ingest.can_bus import CanBus
from fleet_slip.ingest.can_frames import CanFrames
from fleet_slip.ingest.can_trace import CanSource, parse_database
from fleet_slip.ingest.columns import shown
from fleet_slip.ingest.mdf import MdfSource, open_mdf

_FRAME = "CAN_DataFrame."
_EXTENDED = 1 << 31
"""Bit of an identifier that marks one of 29 bits, where there is no channel for it."""
_IDENTIFIER = (1 << 29) - 1


class MdfBus(CanSource):
    """The CAN messages of an MDF file."""

    def __init__(self, file: Path, bus: CanBus, database: Any, mdf: MdfSource) -> None:
        """Take the file's path, what the mapping says of it, the database, and the open file."""
        super().__init__(file, bus, database)
        self._mdf = mdf

    @cached_property
    def _frames(self) -> dict[tuple[int, bool], CanFrames]:
        frames: dict[tuple[int, bool], CanFrames] = defaultdict(CanFrames)
        for number, places in self._mdf.groups_with(f"{_FRAME}ID"):
            for key, frame in self._group(number, places):
                frames[key].append(*frame)
        if not frames:
            raise InputError(
                f"{shown(self._file)}: there is no CAN frame in it ({_FRAME}ID). Map its channels "
                "without [can] in the mapping."
            )
        return dict(frames)

    def _group(
        self, number: int, places: dict[str, int]
    ) -> Iterator[tuple[tuple[int, bool], tuple[float, str, bytes]]]:
        """Yield the frames of a group, with their identifiers."""
        names = ("ID", "DataBytes", "DataLength", "IDE", "BusChannel")
        there = {n: places[_FRAME + n] for n in names if _FRAME + n in places}
        if "DataBytes" not in there:
            raise InputError(
                f"{shown(self._file)}: group {number} has frames without {_FRAME}DataBytes. Export "
                "it again, with payloads."
            )
        found = dict(zip(there, self._mdf.select(number, there), strict=True))
        numbers = found["ID"].samples.astype(np.int64)
        extended = numbers & _EXTENDED != 0
        if "IDE" in found:
            extended |= found["IDE"].samples.astype(np.int64) != 0
        payloads = found["DataBytes"].samples
        lengths = np.full(len(numbers), payloads.shape[-1] if payloads.ndim > 1 else 64)
        if "DataLength" in found:
            lengths = np.minimum(lengths, found["DataLength"].samples.astype(np.int64))
        buses = found["BusChannel"].samples if "BusChannel" in found else np.zeros(len(numbers))
        keys = zip((numbers & _IDENTIFIER).tolist(), extended.tolist(), strict=True)
        rows = zip(self._mdf.times_s(found["ID"]).tolist(), buses, payloads, lengths, strict=True)
        for key, (time, bus, payload, length) in zip(keys, rows, strict=True):
            yield key, (time, str(int(bus)), bytes(payload)[: int(length)])


@contextmanager
def open_mdf_bus(file: Path, bus: CanBus) -> Iterator[MdfBus]:
    """Open an MDF file for the CAN frames in it. Raises `InputError`."""
    database = parse_database(bus)
    with open_mdf(file) as mdf:
        yield MdfBus(file, bus, database, mdf)
