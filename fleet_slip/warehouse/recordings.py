"""Tells a recording by its samples, whatever its file, its mapping or its car is called.

A signal's counts are cut where four in a row hash to a certain value, so that the same samples are
cut alike wherever they begin: some 128 counts a piece. The hashes of pieces in which enough happens
are the drive's `parts`. A drive in which too little happens, such as one of a car that stands, is
told by its `whole`: car, day, ticks and counts. Of a recording that is to be known again the whole
and a fixed number of its parts are kept, the least ones: the same of any two.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray

Hashes = NDArray[np.uint64]
_U = np.uint64

ABSENT = -(2**15)
"""Stands for a count that is missing; no count is it."""

CUT_BITS = 7
"""A piece ends where so many bits of a hash are zero: after 128 counts on average."""

BENDS = 16
"""Counts of a piece, at least, that do not go on from the two before them in a straight line."""

PARTS_KEPT = 64
"""Of a recording that is to be known again."""

PARTS_ENOUGH = 16
"""One of so many kept parts, rounded up, makes a drive the same recording."""


@dataclass(frozen=True)
class Recording:
    """The samples of one drive as hashes: of them all, and of their pieces, sorted."""

    whole: int
    parts: Hashes

    def kept(self) -> str:
        """Return what tells it again later, as text: neither names nor samples follow from it."""
        kept = np.concatenate([np.array([self.whole], np.uint64), self.parts[:PARTS_KEPT]])
        return base64.b64encode(kept.astype("<u8").tobytes()).decode("ascii")


def record_drive(
    vehicle_id: str, day: str, ticks: pa.Array, counts: Mapping[str, pa.Array]
) -> Recording:
    """Return the recording of a drive: its ticks and, by signal, its int16 counts or null."""
    whole = blake2b(f"{vehicle_id}\n{day}\n".encode(), digest_size=8)
    whole.update(np.asarray(ticks, dtype="<i4").tobytes())
    parts = []
    for _, column in sorted(counts.items()):
        if column.null_count == len(column):
            continue
        values = np.asarray(column.fill_null(ABSENT), dtype="<i2")
        whole.update(values.tobytes())
        parts.append(_hash_pieces(values[values != ABSENT].astype(np.int64)))
    return Recording(
        int.from_bytes(whole.digest(), "little"),
        np.unique(np.concatenate(parts)) if parts else np.empty(0, np.uint64),
    )


class KnownRecordings:
    """Recordings to be known again, each as `Recording.kept` returned it."""

    def __init__(self, kept: Sequence[str]) -> None:
        """Take what was kept."""
        each = [np.frombuffer(base64.b64decode(text), "<u8").astype(np.uint64) for text in kept]
        sizes = np.array([len(one) - 1 for one in each])
        self._wholes = frozenset(int(one[0]) for one in each)
        self._parts = np.concatenate([one[1:] for one in each])
        self._owners = np.repeat(np.arange(len(each)), sizes)
        self._enough = np.maximum(1, -(-sizes // PARTS_ENOUGH))

    def has(self, drive: Recording) -> bool:
        """Whether a drive is one of them, or enough of one is in it."""
        if drive.whole in self._wholes:
            return True
        there = self._owners[np.isin(self._parts, drive.parts)]
        return bool((np.bincount(there, minlength=len(self._enough)) >= self._enough).any())


SPOT_TICKS = 20
"""A recording that comes at another rate has the same samples at every fifth of a second, if its
rate is 5, 10, 20, 25, 50 or 100 Hz."""

SPOT_SIGNALS = ("yaw_rate", "ay", "wheel_fl")
"""What is looked at, if a drive has it; of other signals the first ones, as many."""

SPOTS_PER_SIGNAL, SPOT_CUT_BITS = 2, 5


@dataclass(frozen=True)
class Spots:
    """Hashes that tell a drive again at another rate, with another sign or another zero.

    Attributes:
        kept: of every fifth of a second from the first sample on; the least ones, a few.
        seen: of every fifth of a second from any of the first 20 samples on.
    """

    kept: Hashes
    seen: Hashes


def find_spots(ticks: NDArray[np.signedinteger[Any]], counts: Mapping[str, pa.Array]) -> Spots:
    """Return the spots of a drive: its ticks and, by signal, its int16 counts or null."""
    import polars as pl  # noqa: PLC0415 - takes a while

    moving = [name for name, column in counts.items() if column.null_count < len(column)]
    first = [name for name in SPOT_SIGNALS if name in moving]
    others = sorted(set(moving).difference(first))
    phase = ((ticks - ticks[:1]) % SPOT_TICKS).astype(np.uint8)
    kept, seen = [], []
    for name in [*first, *others][: len(SPOT_SIGNALS)]:
        filled = pl.Series(counts[name]).cast(pl.Int64).fill_null(ABSENT)
        values = filled.to_numpy()  # Arrow's own would load pandas
        there = values != ABSENT
        order = np.argsort(phase[there], kind="stable")
        by_phase, phases = values[there][order], phase[there][order]
        begins = np.searchsorted(phases, np.arange(1, SPOT_TICKS))
        changes = np.abs(np.diff(by_phase))
        own = _hash_pieces(changes[: max(int(begins[0]) - 1, 0)], SPOT_CUT_BITS)
        kept.append(np.unique(own)[:SPOTS_PER_SIGNAL])
        seen.append(_hash_pieces(changes, SPOT_CUT_BITS, begins))
    none = np.empty(0, np.uint64)
    return Spots(*(np.unique(np.concatenate([none, *each])) for each in (kept, seen)))


def _hash_pieces(
    values: IntArray, cut_bits: int = CUT_BITS, begins: IntArray | None = None
) -> Hashes:
    """Return the hashes of the pieces of a signal in which enough happens.

    At `begins` it is cut, too.
    """
    if len(values) < BENDS:
        return np.empty(0, np.uint64)
    words: Hashes = (values & 0xFFFF).astype(np.uint64)
    fours: Hashes = words[:-3] | words[1:-2] << _U(16) | words[2:-1] << _U(32) | words[3:] << _U(48)
    mixed = _mix(fours)
    starts = np.concatenate([[0], np.flatnonzero(mixed >> _U(64 - cut_bits) == 0) + 1])
    if begins is not None:
        starts = np.union1d(starts, begins)
    starts = starts[starts < len(mixed)]
    bends = (np.diff(values, 2) != 0)[: len(mixed)]
    eventful = np.add.reduceat(bends, starts, dtype=np.int64) >= BENDS
    return _mix(np.add.reduceat(mixed, starts)[eventful])


def _mix(words: Hashes) -> Hashes:
    """Return hashes of 64-bit words: the finaliser of SplitMix64 (Steele et al., 2014)."""
    mixed: Hashes = (words ^ words >> _U(30)) * _U(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ mixed >> _U(27)) * _U(0x94D049BB133111EB)
    return mixed ^ mixed >> _U(31)
