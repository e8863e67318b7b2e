"""Messages of cars in the schema of the table `grams`, and back.

A received row has n, sums and products of its message, and its drive's name tells the car and the
moment. The column `signed` has the rest, 80 bytes: the signature, what the signals meant, which
they were, and the place among the drive's messages. So the signature can be checked again. It is
null of rows that were not signed, and a file without any has no such column.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.grams.received.messages import KEPT, MAGIC, SIGNED_LAYOUT, Messages, message_type
from fleet_slip.grams.received.plausible import find_impossible
from fleet_slip.grams.received.received_rows import ReceivedRows, signals_of
from fleet_slip.grams.received.signatures import FORGED, KEYS_VARIABLE, CarKeys, check_signatures
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table, is_received, list_array
from fleet_slip.warehouse.tables import SIGNED
from fleet_slip.words import number_of

OTHER_ROW = "has a signature that is of no message of it"


def received_table(rows: ReceivedRows, schema: pa.Schema, digests: Sequence[str] = ()) -> pa.Table:
    """Return rows of the same signals in the schema of `grams`, from files of these digests."""
    many = len(rows)
    names = pa.array([f"{RECEIVED_FILES}{digest[:24]}" for digest in digests], pa.string())
    known: dict[str, Any] = {
        "feature_set": pa.repeat(features().identity(PLAIN), many),
        "file": names.take(pa.array(rows.file)) if digests else pa.repeat(RECEIVED_FILES, many),
        "day": rows.days,
        "drive_id": rows.drive_ids,
        "vehicle_id": rows.vehicle_ids,
        "source": pa.repeat(RECEIVED, many),
        "signals": pa.repeat(signals_of(rows.mask), many),
        "n": pa.array(rows.n),
        "clipped": pa.repeat(0, many),
        "sums": list_array(rows.sums),
        "products": list_array(rows.products),
        SIGNED: _signed_column(rows.kept),
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


def messages_again(signals: str, rows: pa.RecordBatch) -> tuple[Messages, BoolArray]:
    """Rebuild signed messages of rows, without checksums; and tell whose signature fits."""
    count = len(signals.split(",")) if signals else 0
    content = rows[SIGNED].to_pylist()
    fits = np.array([len(one) == KEPT.itemsize for one in content], dtype=np.bool_)
    blank = bytes(KEPT.itemsize)
    sized = (one if fit else blank for one, fit in zip(content, fits, strict=True))
    kept = np.frombuffer(b"".join(sized), KEPT)
    moments = pc.utf8_slice_codeunits(rows["drive_id"].cast(pa.string()), -16)
    started = pc.strptime(moments, "%Y%m%dT%H%M%SZ", "s", error_is_null=True)
    fits &= np.asarray(started.is_valid().to_numpy(zero_copy_only=False), dtype=np.bool_)
    fits &= np.bitwise_count(kept["mask"]) == count
    messages: Any = np.zeros(len(rows), message_type(count, signed=True))
    messages["magic"], messages["layout"] = MAGIC, SIGNED_LAYOUT
    messages["length"] = messages.dtype.itemsize
    messages["vehicle"] = np.array(rows["vehicle_id"].cast(pa.string()).to_pylist(), "S16")
    messages["start_s"] = started.fill_null(0).cast(pa.int64()).to_numpy().astype(np.uint64)
    messages["rows"] = rows["n"].to_numpy().astype(np.uint32)
    for name in KEPT.names or ():
        messages[name] = kept[name]
    if count:
        table = gram_table(signals, rows)
        messages["numbers"] = np.hstack([table.sums, table.products])
    return messages, fits


def find_unsound(rows: pa.Table) -> Iterator[tuple[str, str]]:
    """Yield the drives whose received Gram rows cannot be true, each as it came, and why."""
    came = rows.filter(is_received(rows))
    drives, vehicles = (came[name].cast(pa.string()) for name in ("drive_id", "vehicle_id"))
    of_day = pc.binary_join_element_wise(vehicles, pc.strftime(came["day"], "%Y%m%dT"), "-")
    others = pc.not_equal(pc.utf8_slice_codeunits(drives, 0, -len("HHMMSSZ")), of_day)
    for drive in drives.filter(others).to_pylist():
        yield drive, "is of another car or day than its drive"
    others = pc.not_equal(came["feature_set"], features().identity(PLAIN))
    for drive in drives.filter(others).to_pylist():
        yield drive, "is of another feature set than the logged signals"
    for batch in came.combine_chunks().to_batches():
        for signals, some, _ in by_signals(batch):
            yield from _impossible(signals, some)


def _impossible(signals: str, rows: pa.RecordBatch) -> Iterator[tuple[str, str]]:
    drives = rows["drive_id"].to_pylist()
    names = signals.split(",") if signals else []
    known = catalogue()
    if not set(names) <= set(known.gram_signals):
        yield from ((drive, "has signals that there are not") for drive in drives)
        return
    if not names:
        return
    table = gram_table(signals, rows)
    ranges = [(known[name].min_count, known[name].max_count) for name in names]
    for reason, at in find_impossible(table.n, table.sums, table.products, ranges).items():
        yield from ((drives[one], reason) for one in at.tolist())


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
    for batch in mine.take(np.arange(0, len(mine), step)).combine_chunks().to_batches():
        for signals, some, _ in by_signals(batch):
            keyless += _check(found, signals, some, keys)
    if keyless:
        told = f"{number_of(keyless, 'signature')} of messages not checked"
        found.unchecked.append(f"{told}: the list of keys has no key of the car on that day")
    if unsigned := len(came) - len(mine):
        found.unchecked.append(f"{number_of(unsigned, 'message')} landed without a signature")
    return found


def _check(found: SignatureCheck, signals: str, rows: pa.RecordBatch, keys: CarKeys) -> int:
    """Check rows of the same signals; return how many cars have no key on their day."""
    drives, cars = (rows[name].cast(pa.string()).to_pylist() for name in ("drive_id", "vehicle_id"))
    messages, fits = messages_again(signals, rows)
    known = [keys.of(car, day) for car, day in zip(cars, rows["day"].to_pylist(), strict=True)]
    asked = [at for at, key in enumerate(known) if key is not None and fits[at]]
    right = check_signatures(messages[asked], [key.bytes for at in asked if (key := known[at])])
    found.checked += len(asked)
    forged = np.array(asked, dtype=np.int64)[~right]
    found.forged += [(drives[at], FORGED) for at in forged.tolist()]
    found.forged += [(drives[at], OTHER_ROW) for at in np.flatnonzero(~fits).tolist()]
    return sum(key is None for key in known)
