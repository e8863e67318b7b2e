"""Checks the signatures again that the messages of received Gram rows had."""

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from fleet_slip.grams.received.car_keys import KEYS_VARIABLE, CarKeys
from fleet_slip.grams.received.received_rows import is_received
from fleet_slip.grams.received.signatures import FORGED, check_signatures
from fleet_slip.grams.received.signed_rows import messages_again
from fleet_slip.grams.rows.gram_rows import by_signals
from fleet_slip.warehouse.tables import SIGNED
from fleet_slip.words import number_of

OTHER_ROW = "has a signature that is of no message of it"


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
