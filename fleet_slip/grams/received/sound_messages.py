"""Refuses messages of cars that contradict themselves, and groups the others by layout."""

import re
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.course_change import LATE_PARTS, MOST_EARLY, MOST_LATE
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.grams.received.counted_sets import counted_sets
from fleet_slip.grams.received.found_messages import FoundMessages
from fleet_slip.grams.received.messages import (
    LONGEST_VEHICLE,
    Messages,
    keep_signatures,
    without_signatures,
)
from fleet_slip.grams.received.plausible import find_impossible
from fleet_slip.grams.received.received_rows import ReceivedRows, Refused, columns_of

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


def _kinds(messages: Messages) -> IntArray:
    """Return what tells which messages stand together, shape (m, numbers)."""
    some = messages["definition"].view(np.int64)[:, None]
    if "mask" in (messages.dtype.names or ()):
        return np.column_stack([some, messages["mask"].astype(np.int64)])
    words = messages["columns"].astype(np.int64)
    return np.hstack([some, messages["part"].astype(np.int64)[:, None], words])


Judge = Callable[[ReceivedRows], Iterable[str | None]]
"""Tells why each of some messages is not to be believed, None where it is."""


def sort_out(
    found: Iterable[tuple[int, FoundMessages]], judge: Judge | None = None
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


def by_layout(file: int, found: FoundMessages) -> Iterator[ReceivedRows]:
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
