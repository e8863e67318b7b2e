"""Messages of cars in the schema of the table `grams`."""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.grams.received.received_rows import ReceivedRows, signals_of
from fleet_slip.grams.received.signed_rows import signed_column
from fleet_slip.grams.rows.gram_rows import list_array
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
        SIGNED: signed_column(rows.kept),
    }
    columns = [
        known[one.name].cast(one.type) if one.name in known else pa.nulls(many, one.type)
        for one in schema
    ]
    return pa.table(columns, schema=schema)
