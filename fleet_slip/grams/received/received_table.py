"""Messages of cars in the schema of the table `grams`, and back.

A received row has n, sums and products of its message, and its drive's name tells the car and the
moment. The column `signed` has the rest, 80 bytes: the signature, what the signals meant, which
they were, and the place among the drive's messages. So the signature can be checked again. It is
null of rows that were not signed, and a file without any has no such column.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.grams.received.messages import KEPT, MAGIC, SIGNED_LAYOUT, Messages, message_type
from fleet_slip.grams.received.received_rows import ReceivedRows, signals_of
from fleet_slip.grams.rows.gram_rows import gram_table, list_array
from fleet_slip.warehouse.tables import SIGNED


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
    """Rebuild the signed messages behind rows of the same signals, without their checksums.

    And which of them the column fits: where it does not, it was not this row's.
    """
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
