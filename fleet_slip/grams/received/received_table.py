"""Messages of cars in the schema of the table `grams`, and back.

A received row has n, sums and products of its message, and its drive's name tells the car and the
moment. The column `signed` has the rest, 80 bytes: the signature, what the signals meant, which
they were, and the place among the drive's messages. So the signature can be checked again. It is
null of rows that were not signed, and a file without any has no such column. Of a row of a feature
set, its columns, its part and the delay of its course stand in the table.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.course_change import COURSE_LATE
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.errors import QuestionError
from fleet_slip.grams.received.counted_sets import CountedSet, counted_by_identity
from fleet_slip.grams.received.messages import (
    KEPT,
    LAYOUT,
    MAGIC,
    SET_LAYOUT,
    SIGNED_LAYOUTS,
    Messages,
    message_type,
)
from fleet_slip.grams.received.plausible import find_impossible
from fleet_slip.grams.received.received_rows import ReceivedRows
from fleet_slip.grams.received.signatures import FORGED, KEYS_VARIABLE, CarKeys, check_signatures
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
        SIGNED: _signed_column(rows.kept),
        **({} if part is None else {"part": pa.repeat(part, many)}),
        **({COURSE_LATE: pa.array(rows.late)} if rows.of.in_time else {}),
    }
    columns = [
        known[one.name].cast(one.type) if one.name in known else pa.nulls(many, one.type)
        for one in schema
    ]
    return pa.table(columns, schema=schema)


def _signed_column(kept: Messages) -> pa.Array:
    """Return the column of the table."""
    signed = kept["parts"] > 0
    if not signed.any():
        return pa.nulls(len(kept), pa.binary())
    content = pa.py_buffer(np.ascontiguousarray(kept).tobytes())
    whole = pa.FixedSizeBinaryArray.from_buffers(
        pa.binary(KEPT.itemsize), len(kept), [None, content]
    )
    return pc.if_else(pa.array(signed), whole.cast(pa.binary()), None)


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
) -> tuple[Messages, BoolArray]:
    """Rebuild signed messages of rows, without checksums; and tell whose signature fits."""
    names = signals.split(",") if signals else []
    of_set = one.name != PLAIN
    content = rows[SIGNED].to_pylist()
    fits = np.array([len(said) == KEPT.itemsize for said in content], dtype=np.bool_)
    blank = bytes(KEPT.itemsize)
    sized = (said if fit else blank for said, fit in zip(content, fits, strict=True))
    kept = np.frombuffer(b"".join(sized), KEPT)
    moments = pc.utf8_slice_codeunits(rows["drive_id"].cast(pa.string()), -16)
    started = pc.strptime(moments, "%Y%m%dT%H%M%SZ", "s", error_is_null=True)
    fits &= np.asarray(started.is_valid().to_numpy(zero_copy_only=False), dtype=np.bool_)
    fits &= np.bitwise_count(kept["mask"]) == (0 if of_set else len(names))
    messages: Any = np.zeros(len(rows), message_type(len(names), signed=True, of_set=of_set))
    messages["magic"] = MAGIC
    messages["layout"] = SIGNED_LAYOUTS[SET_LAYOUT if of_set else LAYOUT]
    messages["length"] = messages.dtype.itemsize
    messages["vehicle"] = np.array(rows["vehicle_id"].cast(pa.string()).to_pylist(), "S16")
    messages["start_s"] = started.fill_null(0).cast(pa.int64()).to_numpy().astype(np.uint64)
    messages["rows"] = rows["n"].to_numpy().astype(np.uint32)
    for name in set(KEPT.names or ()).intersection(messages.dtype.names or ()):
        messages[name] = kept[name]
    if of_set:
        _name_set(messages, one, names, rows)
    if names:
        table = gram_table(signals, rows)
        messages["numbers"] = np.hstack([table.sums, table.products])
    return messages, fits


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
    messages, fits = messages_again(one, signals, rows)
    known = [keys.of(car, day) for car, day in zip(cars, rows["day"].to_pylist(), strict=True)]
    asked = [at for at, key in enumerate(known) if key is not None and fits[at]]
    right = check_signatures(messages[asked], [key.bytes for at in asked if (key := known[at])])
    found.checked += len(asked)
    forged = np.array(asked, dtype=np.int64)[~right]
    found.forged += [(drives[at], FORGED) for at in forged.tolist()]
    found.forged += [(drives[at], OTHER_ROW) for at in np.flatnonzero(~fits).tolist()]
    return sum(key is None for key in known)
