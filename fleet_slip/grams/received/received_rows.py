"""Messages of cars as rows, many at once: what they say, and which of them cannot be."""

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.course_change import LATE_PARTS, MOST_EARLY, MOST_LATE
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.grams.received.counted_sets import CountedSet, counted_sets
from fleet_slip.grams.received.found_messages import Found
from fleet_slip.grams.received.messages import (
    LONGEST_VEHICLE,
    Messages,
    keep_signatures,
    without_signatures,
)
from fleet_slip.grams.received.plausible import find_impossible

FIRST_START_S = 946_684_800
"""2000-01-01: a car's clock that says less has not been set."""

MARGIN_S = 86_400
"""A car's clock may be ahead by a day, no more: it has a satellite receiver or a network."""

LONGEST_ROWS = 86_400 * round(1 / SAMPLE_TIME_S)
"""Rows of a day: a drive is over by then. A message that says more would outvote a fleet."""

OTHER_SIGNALS = "is of signals that mean something else here"
NO_PARTS = "is of signals or parts that there are not"
NO_DELAY = "is corrected by a delay that no course has"
NO_VEHICLE = "has no name of a car"
NO_MOMENT = "begins before 2000, or ends in the future"
TOO_LONG = "is of a drive longer than a day"
LACKS_ROWS = "lacks rows of its drive"

_IN_NAMES = np.array([bool(re.match(rb"[A-Za-z0-9._-]", bytes([b]))) for b in range(256)])


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


def _kinds(messages: Messages) -> IntArray:
    """Return what tells which messages stand together, shape (m, numbers)."""
    some = messages["definition"].view(np.int64)[:, None]
    if "mask" in (messages.dtype.names or ()):
        return np.column_stack([some, messages["mask"].astype(np.int64)])
    words = messages["columns"].astype(np.int64)
    return np.hstack([some, messages["part"].astype(np.int64)[:, None], words])


Judge = Callable[["ReceivedRows"], Iterable[str | None]]
"""Tells why each of some messages is not to be believed, None where it is."""


def sort_out(
    found: Iterable[tuple[int, Found]], judge: Judge | None = None
) -> tuple[list[ReceivedRows], list[Refused]]:
    """Divide the messages of files into those that may land, by their signals, and others."""
    refused: list[Refused] = []
    runs: dict[tuple[int, ...], list[ReceivedRows]] = {}
    for file, one in found:
        refused += [Refused(file, number, reason) for number, reason in one.refused]
        for run in by_layout(file, one):
            told, nameless = _without_name(run)
            refused += nameless
            if judge is not None and len(told):
                reasons = np.array(list(judge(told)), dtype=object)
                named = sorted({reason for reason in reasons if reason})
                told, forged = told.without({reason: reasons == reason for reason in named})
                refused += forged
            told = replace(told, messages=without_signatures(told.messages))
            kinds = _kinds(told.messages)
            alike = bool((kinds == kinds[:1]).all())
            for kind in kinds[:1] if alike else np.unique(kinds, axis=0):
                some = told.take((kinds == kind).all(axis=1))
                runs.setdefault(tuple(kind.tolist()), []).append(some)
    kept: list[ReceivedRows] = []
    for key in sorted(runs):
        rows, impossible = _possible(ReceivedRows.joined(runs[key]))
        refused += impossible
        kept += [rows] if len(rows) else []
    return kept, refused


def by_layout(file: int, found: Found) -> Iterator[ReceivedRows]:
    """Yield the messages of a file, those of one layout and length together."""
    alike: dict[Any, list[tuple[int, Messages]]] = {}
    for first, messages in found.runs:
        alike.setdefault(messages.dtype, []).append((first, messages))
    for runs in alike.values():
        numbers = np.concatenate([np.arange(at, at + len(some)) for at, some in runs])
        messages = runs[0][1]
        if len(runs) > 1:
            messages = np.frombuffer(b"".join(some.tobytes() for _, some in runs), messages.dtype)
        yield ReceivedRows(
            np.full(len(numbers), file), numbers, messages, keep_signatures(messages)
        )


def _without_name(run: ReceivedRows) -> tuple[ReceivedRows, list[Refused]]:
    """Divide messages into those that tell a drive of today's signals, and the others."""
    said = run.messages
    start_s, latest_s = said["start_s"], int(time.time()) + MARGIN_S
    ends_s = np.minimum(start_s, latest_s) + said["rows"] * float(SAMPLE_TIME_S)
    left = np.ones(len(said), dtype=np.bool_)
    refused: list[Refused] = []
    other, no_parts, no_delay = _of_no_set(said)
    for reason, wrong in (
        (OTHER_SIGNALS, other),
        (NO_PARTS, no_parts | (said["place"] >= said["parts"])),
        (NO_DELAY, no_delay),
        (NO_VEHICLE, ~_is_name(said["vehicle"])),
        (NO_MOMENT, (start_s < FIRST_START_S) | (start_s > latest_s) | (ends_s > latest_s)),
    ):
        bad = left & wrong
        left &= ~wrong
        places = zip(run.file[bad].tolist(), run.number[bad].tolist(), strict=True)
        refused += [Refused(file, number, reason) for file, number in places]
    return run.take(left), refused


def _of_no_set(said: Messages) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return which messages are of no set, of no columns or part of theirs, of no delay in it."""
    other, no_parts, no_delay = np.zeros((3, len(said)), dtype=np.bool_)
    plain = "mask" in (said.dtype.names or ())
    for definition in np.unique(said["definition"]).tolist():
        mine = said["definition"] == definition
        one = counted_sets().get(definition)
        if one is None or plain != (one.name == PLAIN):
            other |= mine
            continue
        no_parts |= mine & columns_of(said)[:, len(one.columns) :].any(axis=1)
        if not plain:
            no_parts |= mine & (said["part"] >= max(1, len(one.times)))
            least, most = (LATE_PARTS * ticks * one.in_time for ticks in (MOST_EARLY, MOST_LATE))
            no_delay |= mine & ((said["late"] < least) | (said["late"] > most))
    return other, no_parts, no_delay


def _is_name(vehicles: Messages) -> BoolArray:
    """Whether bytes are the name of a car: characters of names, then zeros."""
    letters = np.ascontiguousarray(vehicles).view(np.uint8).reshape(-1, LONGEST_VEHICLE)
    zero = letters == 0
    resumed = zero[:, :-1] & ~zero[:, 1:]
    found: BoolArray = (_IN_NAMES[letters] | zero).all(axis=1) & ~zero[:, 0]
    found &= ~resumed.any(axis=1)
    return found


def _possible(rows: ReceivedRows) -> tuple[ReceivedRows, list[Refused]]:
    """Divide messages of the same signals into those that counts can have, and the others."""
    lacking, long = rows.messages["lost"] != 0, rows.n > LONGEST_ROWS
    whole, refused = rows.without({LACKS_ROWS: lacking, TOO_LONG: long})
    ranges = rows.of.ranges_of(rows.signals)
    why = find_impossible(whole.n, whole.sums, whole.products, ranges) if len(whole) else {}
    places = np.arange(len(whole))
    kept, impossible = whole.without({reason: np.isin(places, at) for reason, at in why.items()})
    return kept, [*refused, *impossible]


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
