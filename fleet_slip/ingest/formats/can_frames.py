"""The frames of one CAN message, kept as bytes: some twenty a frame, most in a temporary file."""

from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.ingest.formats.can_decoding import Bytes
from fleet_slip.ingest.logs.spool import Spool

PIECE_FRAMES = 2**12
"""Frames of one message that are in memory at once."""


@dataclass(frozen=True)
class Frames:
    """Some frames: times in s, numbers of buses, sizes in bytes, and all payloads in a row."""

    times_s: FloatArray
    buses: NDArray[np.uint16]
    sizes: NDArray[np.uint16]
    data: Bytes


class CanFrames:
    """The frames of one message, in the order in which they came."""

    def __init__(self, spool: Spool) -> None:
        """Begin without any; what is too much for the memory goes to `spool`."""
        self._spool = spool
        self._numbers: dict[str, int] = {}
        self._found: Counter[tuple[int, int]] = Counter()
        self._clear()

    def _clear(self) -> None:
        self._times, self._buses, self._sizes = array("d"), array("H"), array("H")
        self._data = bytearray()

    def append(self, time_s: float, bus: str, payload: bytes) -> None:
        """Keep a frame."""
        number = self._numbers.setdefault(bus, len(self._numbers))
        self._times.append(time_s)
        self._buses.append(number)
        self._sizes.append(len(payload))
        self._data += payload
        self._found[number, len(payload)] += 1
        if len(self._times) >= PIECE_FRAMES:
            self._put_aside()

    def extend(
        self, times_s: FloatArray, buses: NDArray[np.int64], sizes: NDArray[np.int64], data: Bytes
    ) -> None:
        """Keep frames whose payloads, shape (frames, bytes), are as long as `sizes` say."""
        names, places = np.unique(buses, return_inverse=True)
        known = [self._numbers.setdefault(str(bus), len(self._numbers)) for bus in names.tolist()]
        numbers = np.array(known, dtype=np.uint16)[places]
        for start in range(0, times_s.size, PIECE_FRAMES):
            some = slice(start, start + PIECE_FRAMES)
            found = np.unique(np.stack([numbers[some], sizes[some]]), axis=1, return_counts=True)
            for (number, size), frames in zip(found[0].T.tolist(), found[1].tolist(), strict=True):
                self._found[number, size] += frames
            self._times.frombytes(times_s[some].tobytes())
            self._buses.frombytes(numbers[some].tobytes())
            self._sizes.frombytes(sizes[some].astype(np.uint16).tobytes())
            there = np.arange(data.shape[1]) < sizes[some, np.newaxis]
            self._data += data[some][there].tobytes()
            if len(self._times) >= PIECE_FRAMES:
                self._put_aside()

    def _put_aside(self) -> None:
        for column in (self._times, self._buses, self._sizes, self._data):
            self._spool.add(self, bytes(column))
        self._clear()

    @property
    def buses(self) -> list[str]:
        """The buses that the message is on, sorted."""
        return sorted(self._numbers)

    def sizes_on(self, bus: str | None) -> Counter[int]:
        """Return how many frames have how many bytes, on a bus or on all."""
        number, sizes = self._numbers.get(bus or "", -1), Counter[int]()
        for (of, size), frames in self._found.items():
            if bus is None or of == number:
                sizes[size] += frames
        return sizes

    def take(self, bus: str | None, size: int) -> Iterator[tuple[FloatArray, Bytes]]:
        """Yield times, and the first bytes of each payload, shape (frames, size), piece by piece.

        Frames are those on a bus, or all; none of their payloads may be shorter.
        """
        for some in self._pieces():
            sizes = some.sizes.astype(np.int64)
            starts, times_s = np.cumsum(sizes) - sizes, some.times_s
            if bus is not None:
                chosen = some.buses == self._numbers.get(bus, -1)
                starts, times_s = starts[chosen], times_s[chosen]
            payloads = np.empty((starts.size, size), dtype=np.uint8)
            for place in range(size):
                payloads[:, place] = some.data[starts + place]
            yield times_s, payloads

    def _pieces(self) -> Iterator[Frames]:
        aside = self._spool.read(self)
        for times, buses, sizes, data in zip(aside, aside, aside, aside, strict=True):
            yield _frames(times, buses, sizes, data)
        yield _frames(
            self._times.tobytes(), self._buses.tobytes(), self._sizes.tobytes(), bytes(self._data)
        )


def _frames(times: bytes, buses: bytes, sizes: bytes, data: bytes) -> Frames:
    return Frames(
        np.frombuffer(times),
        np.frombuffer(buses, dtype=np.uint16),
        np.frombuffer(sizes, dtype=np.uint16),
        np.frombuffer(data, dtype=np.uint8),
    )
