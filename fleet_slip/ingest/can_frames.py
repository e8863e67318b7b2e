"""The frames of one CAN message, kept as bytes: some twenty a frame, not two hundred."""

from array import array
from collections.abc import Sequence

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.ingest.can_decoding import Bytes


class CanFrames:
    """Times, buses and payloads of the frames of one message, in the order in which they came."""

    def __init__(self) -> None:
        """Begin without any."""
        self._times, self._buses, self._sizes = array("d"), array("H"), array("H")
        self._data = bytearray()
        self._numbers: dict[str, int] = {}

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self._times)

    def append(self, time_s: float, bus: str, payload: bytes) -> None:
        """Keep a frame."""
        self._times.append(time_s)
        self._buses.append(self._numbers.setdefault(bus, len(self._numbers)))
        self._sizes.append(len(payload))
        self._data += payload

    @property
    def buses(self) -> list[str]:
        """The buses that the message is on, sorted."""
        return sorted(self._numbers)

    def are_on(self, bus: str) -> BoolArray:
        """Return which frames are on a bus."""
        number = self._numbers.get(bus, -1)
        return np.asarray(np.frombuffer(self._buses, dtype=np.uint16) == number)

    @property
    def sizes(self) -> Sequence[int]:
        """Bytes of each payload."""
        return self._sizes

    def take(self, which: BoolArray, size: int) -> tuple[FloatArray, Bytes]:
        """Return times, and the first bytes of each payload, shape (frames, size), of some frames.

        None of their payloads may be shorter.
        """
        sizes = np.frombuffer(self._sizes, dtype=np.uint16).astype(np.int64)
        starts = (np.cumsum(sizes) - sizes)[which]
        data = np.frombuffer(self._data, dtype=np.uint8)
        payloads = np.empty((starts.size, size), dtype=np.uint8)
        for place in range(size):
            payloads[:, place] = data[starts + place]
        return np.frombuffer(self._times)[which], payloads
