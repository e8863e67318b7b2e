"""Messages of cars as rows, many at once: what they say."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.grams.received.counted_sets import CountedSet, counted_sets
from fleet_slip.grams.received.messages import (
    Messages,
)


@dataclass(frozen=True)
class Refused:
    """A message that does not land: its file, its number there, why, and drive and car if known."""

    file: int
    number: int
    reason: str
    drive_id: str | None = None
    vehicle_id: str | None = None


@dataclass(frozen=True)
class ReceivedRows:
    """Messages of the same signals, or columns and part of a set, in the order in which they came.

    Attributes:
        file: which of some files each is from, shape (m,).
        number: which message of its file, from 1.
        messages: what they say, without signatures.
        kept: what is kept of their signatures, None of messages that are not signed.
    """

    file: IntArray
    number: IntArray
    messages: Messages
    kept: Messages

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.messages)

    def take(self, rows: BoolArray | IntArray) -> "ReceivedRows":
        """Return some of the messages; these themselves if a mask has them all."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        return ReceivedRows(*(one[rows] for one in self._arrays))

    @property
    def _arrays(self) -> tuple[IntArray, IntArray, Messages, Messages]:
        return self.file, self.number, self.messages, self.kept

    @classmethod
    def joined(cls, runs: Sequence["ReceivedRows"]) -> "ReceivedRows":
        """Return messages of the same signals behind each other."""
        if len(runs) == 1:
            return runs[0]
        each = zip(*(run._arrays for run in runs), strict=True)
        return cls(*(np.concatenate(arrays) for arrays in each))

    @cached_property
    def of(self) -> CountedSet:
        """The feature set that they are of."""
        return counted_sets()[int(self.messages["definition"][0])]

    @property
    def is_plain(self) -> bool:
        """Whether they are of the logged signals."""
        return self.of.name == PLAIN

    @cached_property
    def signals(self) -> tuple[str, ...]:
        """What they are of: signals, or columns of the set."""
        bits = columns_of(self.messages[:1])[0].tolist()
        return tuple(name for name, there in zip(self.of.columns, bits, strict=False) if there)

    @property
    def kind(self) -> tuple[str, str]:
        """Their set and their signals, as `grams` has them."""
        return self.of.identity, ",".join(self.signals)

    @property
    def part(self) -> int:
        """Which part of their drives they are of, 0 where these are not divided."""
        return 0 if self.is_plain else int(self.messages["part"][0])

    @property
    def late(self) -> IntArray:
        """By how many parts of a tick the course was taken to be late, shape (m,)."""
        return self.messages["late"].astype(np.int64)

    @property
    def n(self) -> IntArray:
        """Numbers of rows, shape (m,)."""
        return self.messages["rows"].astype(np.int64)

    @cached_property
    def numbers(self) -> IntArray:
        """Sums of the k signals, then products, shape (m, k + k(k+1)/2)."""
        return np.ascontiguousarray(self.messages["numbers"])

    @property
    def sums(self) -> IntArray:
        """Sums, shape (m, k)."""
        return self.numbers[:, : len(self.signals)]

    @property
    def products(self) -> IntArray:
        """Packed lower triangles, shape (m, k(k+1)/2)."""
        return self.numbers[:, len(self.signals) :]

    @cached_property
    def vehicle_ids(self) -> pa.StringArray:
        """Names of the cars."""
        return pa.array(np.ascontiguousarray(self.messages["vehicle"])).cast(pa.string())

    @cached_property
    def drive_ids(self) -> pa.StringArray:
        """Names of the drives: the car and the moment."""
        moments = pa.array(_moments(self.messages["start_s"])).cast(pa.string())
        return pc.binary_join_element_wise(self.vehicle_ids, moments, "-")

    @property
    def days(self) -> pa.Date32Array:
        """Days on which the drives began, in UTC."""
        days = self.messages["start_s"] // np.uint64(86_400)
        return pa.array(days.astype(np.int32)).cast(pa.date32())

    def refuse(self, rows: BoolArray | IntArray, reason: str) -> Iterator[Refused]:
        """Yield some of the messages as refused, for a reason."""
        some = self.take(rows)
        columns = (some.file, some.number, some.drive_ids, some.vehicle_ids)
        for file, number, drive, vehicle in zip(*(c.tolist() for c in columns), strict=True):
            yield Refused(file, number, reason, drive, vehicle)

    def without(self, wrong: Mapping[str, BoolArray]) -> tuple["ReceivedRows", list[Refused]]:
        """Return the messages that nothing is wrong with, and the others, by their first reason."""
        left = np.ones(len(self), dtype=np.bool_)
        refused: list[Refused] = []
        for reason, bad in wrong.items():
            refused += self.refuse(left & bad, reason)
            left &= ~bad
        return self.take(left), refused


def columns_of(messages: Messages) -> BoolArray:
    """Return which signals or columns messages are of, a bit for each, shape (m, bits)."""
    words = messages["mask" if "mask" in (messages.dtype.names or ()) else "columns"]
    content = np.ascontiguousarray(words).view(np.uint8).reshape(len(messages), -1)
    found: BoolArray = np.unpackbits(content, axis=1, bitorder="little").astype(np.bool_)
    return found


def _moments(start_s: Messages) -> Messages:
    """Return moments as names of drives have them, such as 20240501T100000Z."""
    seconds = np.ascontiguousarray(start_s).astype("M8[s]")
    day = seconds.astype("M8[D]")
    month = day.astype("M8[M]")
    since_midnight = (seconds - day).astype(np.int64)
    since_1970 = month.astype(np.int64)
    parts = (
        (since_1970 // 12 + 1970, 0, 4),
        (since_1970 % 12 + 1, 4, 2),
        ((day - month).astype(np.int64) + 1, 6, 2),
        (since_midnight // 3600, 9, 2),
        (since_midnight // 60 % 60, 11, 2),
        (since_midnight % 60, 13, 2),
    )
    text = np.tile(np.frombuffer(b"00000000T000000Z", np.uint8), (len(seconds), 1))
    for value, first, digits in parts:
        for i in range(digits):
            text[:, first + i] += (value // 10 ** (digits - 1 - i) % 10).astype(np.uint8)
    return text.view("S16").reshape(-1)
