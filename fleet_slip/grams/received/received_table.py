"""Messages of cars in the schema of the table `grams`, and back.

A received row has n, sums and products of its message, and its drive's name tells the car and the
moment. The column `signed` has the rest, 80 bytes: the signature, what the signals meant, which
they were, and the place among the drive's messages; and of a message whose day is signed, where it
stands in the tree. So the signature can be checked again. It is
null of rows that were not signed, and a file without any has no such column. Of a row of a feature
set, its columns, its part and the delay of its course stand in the table.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.course_change import COURSE_LATE
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.errors import QuestionError
from fleet_slip.grams.received.car_keys import KEYS_VARIABLE, CarKeys
from fleet_slip.grams.received.counted_sets import CountedSet, counted_by_identity
from fleet_slip.grams.received.messages import (
    DAY_LAYOUTS,
    LAYOUT,
    MAGIC,
    MOST_LEVELS,
    SET_LAYOUT,
    SIGNED_LAYOUTS,
    Messages,
    kept_type,
    message_type,
)
from fleet_slip.grams.received.plausible import find_impossible
from fleet_slip.grams.received.received_rows import ReceivedRows
from fleet_slip.grams.received.signatures import FORGED, check_signatures
from fleet_slip.grams.rows.drive_parts import Parts
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table, is_received, list_array
from fleet_slip.warehouse.tables import SIGNED
from fleet_slip.words import number_of

OTHER_ROW = "has a signature that is of no message of it"


def received_table(rows: ReceivedRows, schema: pa.Schema, digests: Sequence[str] = ()) -> pa.Table:
    """Return rows of the same signals in the schema of `grams`, from files of these digests."""
    many = len(rows)
    part = _part_names(rows.of).get(rows.part)
    names = pa.array([f"{RECEIVED_FILES}{digest[:24]}" for digest in digests], pa.string())
    known: dict[str, Any] = {
        "feature_set": pa.repeat(rows.of.identity, many),
        "file": names.take(pa.array(rows.file)) if digests else pa.repeat(RECEIVED_FILES, many),
        "day": rows.days,
        "drive_id": rows.drive_ids,
        "vehicle_id": rows.vehicle_ids,
        "source": pa.repeat(RECEIVED, many),
        "signals": pa.repeat(",".join(rows.signals), many),
        "n": pa.array(rows.n),
        "clipped": pa.repeat(0, many),
        "sums": list_array(rows.sums),
        "products": list_array(rows.products),
        SIGNED: pa.array(rows.kept, pa.binary()),
        **({} if part is None else {"part": pa.repeat(part, many)}),
        **({COURSE_LATE: pa.array(rows.late)} if rows.of.in_time else {}),
    }
    columns = [
        known[one.name].cast(one.type) if one.name in known else pa.nulls(many, one.type)
        for one in schema
    ]
    return pa.table(columns, schema=schema)


def _part_names(one: CountedSet) -> dict[int, str]:
    """Return the names of the parts of drives, by their numbers; none if they are not divided."""
    names = Parts.of_set(features(), features().feature_set(one.name)).times
    return dict(enumerate(names))


def of_part(rows: pa.RecordBatch, like: ReceivedRows) -> pa.RecordBatch:
    """Return the rows of the same part of their drives as some messages."""
    part = _part_names(like.of).get(like.part)
    return rows if part is None else rows.filter(pc.equal(rows["part"], part))


def messages_again(
    one: CountedSet, signals: str, rows: pa.RecordBatch
) -> Iterator[tuple[IntArray, Messages]]:
    """Rebuild signed messages of rows, without checksums: those of one layout, and which they are.

    Rows whose signature does not fit them are in none.
    """
    names = signals.split(",") if signals else []
    of_set = one.name != PLAIN
    content = rows[SIGNED].to_pylist()
    moments = pc.utf8_slice_codeunits(rows["drive_id"].cast(pa.string()), -16)
    started = pc.strptime(moments, "%Y%m%dT%H%M%SZ", "s", error_is_null=True)
    dated = np.asarray(started.is_valid().to_numpy(zero_copy_only=False), dtype=np.bool_)
    for levels in (None, *range(MOST_LEVELS + 1)):
        kind = kept_type(levels)
        sized = np.array([len(said) == kind.itemsize for said in content], dtype=np.bool_)
        at = np.flatnonzero(sized & dated)
        kept = np.frombuffer(b"".join(content[place] for place in at), kind)
        fits = np.bitwise_count(kept["mask"]) == (0 if of_set else len(names))
        at, kept = at[fits], kept[fits]
        if not len(at):
            continue
        some = rows.take(pa.array(at))
        messages: Any = np.zeros(
            len(at), message_type(len(names), signed=True, of_set=of_set, levels=levels)
        )
        layout = SET_LAYOUT if of_set else LAYOUT
        signed = SIGNED_LAYOUTS[layout] if levels is None else DAY_LAYOUTS[layout] + levels
        messages["magic"], messages["layout"] = MAGIC, signed
        messages["length"] = messages.dtype.itemsize
        messages["vehicle"] = np.array(some["vehicle_id"].cast(pa.string()).to_pylist(), "S16")
        messages["start_s"] = started.take(pa.array(at)).cast(pa.int64()).to_numpy()
        messages["rows"] = some["n"].to_numpy().astype(np.uint32)
        for name in set(kind.names or ()).intersection(messages.dtype.names or ()):
            messages[name] = kept[name]
        if of_set:
            _name_set(messages, one, names, some)
        if names:
            table = gram_table(signals, some)
            messages["numbers"] = np.hstack([table.sums, table.products])
        yield at, messages


def _name_set(
    messages: Messages, one: CountedSet, columns: Sequence[str], rows: pa.RecordBatch
) -> None:
    """Write which columns of a set messages are of, and of which part of their drives."""
    bits = np.zeros(messages["columns"].shape[1] * 64, dtype=np.uint8)
    bits[[one.columns.index(name) for name in columns]] = 1
    messages["columns"] = np.packbits(bits, bitorder="little").view("<u8")
    numbers = {name: number for number, name in _part_names(one).items()}
    messages["part"] = [numbers.get(part, 0) for part in rows["part"].to_pylist()]
    if one.in_time:
        messages["late"] = rows[COURSE_LATE].fill_null(0).to_numpy()


def find_unsound(rows: pa.Table) -> Iterator[tuple[str, str]]:
    """Yield the drives whose received Gram rows cannot be true, each as it came, and why."""
    came = rows.filter(is_received(rows))
    drives, vehicles = (came[name].cast(pa.string()) for name in ("drive_id", "vehicle_id"))
    of_day = pc.binary_join_element_wise(vehicles, pc.strftime(came["day"], "%Y%m%dT"), "-")
    others = pc.not_equal(pc.utf8_slice_codeunits(drives, 0, -len("HHMMSSZ")), of_day)
    for drive in drives.filter(others).to_pylist():
        yield drive, "is of another car or day than its drive"
    for identity in came["feature_set"].unique().to_pylist():
        some = came.filter(pc.equal(came["feature_set"], identity))
        one = counted_by_identity().get(identity)
        if one is None:
            if _is_known(identity):
                for drive in some["drive_id"].to_pylist():
                    yield drive, "is of a feature set that cars do not count"
            continue
        for batch in some.combine_chunks().to_batches():
            for signals, alike, _ in by_signals(batch):
                yield from _impossible(one, signals, alike)


def _is_known(identity: str) -> bool:
    """Whether a feature set is defined like that today; else its rows cannot be judged."""
    try:
        return bool(features().name_of(identity))
    except QuestionError:
        return False


def _impossible(one: CountedSet, signals: str, rows: pa.RecordBatch) -> Iterator[tuple[str, str]]:
    drives = rows["drive_id"].to_pylist()
    names = signals.split(",") if signals else []
    if not set(names) <= set(one.columns):
        yield from ((drive, "has signals that there are not") for drive in drives)
        return
    if not names:
        return
    table = gram_table(signals, rows)
    ranges = one.ranges_of(names)
    for reason, at in find_impossible(table.n, table.sums, table.products, ranges).items():
        yield from ((drives[place], reason) for place in at.tolist())


@dataclass
class SignatureCheck:
    """What a check of signatures found.

    Attributes:
        signed: received rows with a signature.
        checked: how many of these were checked.
        forged: drives, and why their row is not what the key of its car signed.
        unchecked: what was not checked, and why.
    """

    signed: int = 0
    checked: int = 0
    forged: list[tuple[str, str]] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)


def check_signed_rows(
    rows: pa.Table, keys: CarKeys | None, most: int | None = None
) -> SignatureCheck:
    """Check the signatures of received rows of `grams`, so many evenly chosen ones at most.

    Without a list of keys they are counted. A key that was revoked is a key: what it signed was
    signed.
    """
    came = rows.filter(is_received(rows))
    mine = came.filter(came[SIGNED].is_valid()) if SIGNED in came.column_names else came[:0]
    found = SignatureCheck(signed=len(mine))
    if keys is None:
        if len(mine):
            told = f"{number_of(len(mine), 'signature')} of messages not checked"
            found.unchecked.append(f"{told}: ${KEYS_VARIABLE} names no list of keys")
        return found
    step = 1 if most is None else max(1, -(-len(mine) // most))
    keyless = 0
    sample = mine.take(np.arange(0, len(mine), step))
    for identity in sample["feature_set"].unique().to_pylist():
        some = sample.filter(pc.equal(sample["feature_set"], identity))
        one = counted_by_identity().get(identity)
        if one is None:
            told = f"{number_of(len(some), 'signature')} of messages not checked"
            found.unchecked.append(f"{told}: the feature set {identity} is defined otherwise now")
            continue
        for batch in some.combine_chunks().to_batches():
            for signals, alike, _ in by_signals(batch):
                keyless += _check(found, one, signals, alike, keys)
    if keyless:
        told = f"{number_of(keyless, 'signature')} of messages not checked"
        found.unchecked.append(f"{told}: the list of keys has no key of the car on that day")
    if unsigned := len(came) - len(mine):
        found.unchecked.append(f"{number_of(unsigned, 'message')} landed without a signature")
    return found


def _check(
    found: SignatureCheck, one: CountedSet, signals: str, rows: pa.RecordBatch, keys: CarKeys
) -> int:
    """Check rows of the same signals; return how many cars have no key on their day."""
    drives, cars = (rows[name].cast(pa.string()).to_pylist() for name in ("drive_id", "vehicle_id"))
    known = [keys.of(car, day) for car, day in zip(cars, rows["day"].to_pylist(), strict=True)]
    others = set(range(len(rows)))
    for at, messages in messages_again(one, signals, rows):
        others.difference_update(at.tolist())
        asked = np.array([known[place] is not None for place in at], dtype=np.bool_)
        public = [key.bytes for place in at if (key := known[place])]
        right = check_signatures(messages[asked], public)
        found.checked += len(right)
        found.forged += [(drives[place], FORGED) for place in at[asked][~right]]
    found.forged += [(drives[place], OTHER_ROW) for place in sorted(others)]
    return sum(key is None for key in known)
