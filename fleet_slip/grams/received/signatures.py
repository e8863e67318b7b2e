"""Signatures of messages: Ed25519, by the car's gateway, over all that stands before them.

A signed message has the layout 2: it is 64 bytes longer, which stand before its checksum. The
signature is over `DOMAIN` and all bytes before it.
"""

import os
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import InputError
from fleet_slip.extras import needed
from fleet_slip.grams.received.car_keys import CarKey, CarKeys
from fleet_slip.grams.received.messages import (
    CHECKSUM_BYTES,
    SIGNATURE_BYTES,
    SIGNED_LAYOUT,
    Messages,
    read_messages,
)
from fleet_slip.grams.received.received_rows import ReceivedRows

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

DOMAIN = b"fleet-slip gram message\n"
"""Before what is signed: the same key signs nothing else that could be taken for a message."""

AT_ONCE = 256
"""Messages that a thread checks one after the other."""

UNSIGNED = "is not signed"
NO_KEY = "is of a car that had no key on that day"
REVOKED = "is signed by a key that was revoked"
FORGED = "is not signed by the key of its car"


def sign_messages(content: bytes, private_key: bytes) -> bytes:
    """Sign each of the messages that stand one behind the other.

    `private_key` is Ed25519 in PEM, as `fleet-slip keygen` makes it. Raises `InputError` for what
    is no sound message or is signed already, and for what is no such key; `ExtraError` if the extra
    `signing` is not installed.
    """
    with needed("signing", "a signature"):
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415
        from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415
    try:
        key = load_pem_private_key(private_key, password=None)
    except (ValueError, TypeError):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        raise InputError("the key is not an unencrypted Ed25519 private key in PEM.")
    found = read_messages(content)
    if found.refused:
        number, reason = found.refused[0]
        raise InputError(f"message {number} {reason}: nothing is signed.")
    signed = []
    for first, messages in found.runs:
        if messages["layout"][0] == SIGNED_LAYOUT:
            raise InputError(f"message {first} is signed already.")
        for message in messages:
            body = bytearray(message.tobytes()[:-CHECKSUM_BYTES])
            size = len(body) + SIGNATURE_BYTES + CHECKSUM_BYTES
            body[4:8] = SIGNED_LAYOUT.to_bytes(2, "little") + size.to_bytes(2, "little")
            body += key.sign(DOMAIN + body)
            signed.append(bytes(body) + zlib.crc32(body).to_bytes(CHECKSUM_BYTES, "little"))
    return b"".join(signed)


def judge_signatures(rows: ReceivedRows, keys: CarKeys) -> list[str | None]:
    """Return why each message is refused; None where the key of its car signed it."""
    layout = int(rows.messages["layout"][0])
    cars, days = rows.vehicle_ids.to_pylist(), rows.days.to_pylist()
    known = [keys.of(car, day) for car, day in zip(cars, days, strict=True)]
    told = [_without_looking(layout, key) for key in known]
    asked = [at for at, why in enumerate(told) if why is None]
    public = [key.bytes for at in asked if (key := known[at])]
    right = check_signatures(rows.messages[asked], public)
    for at in np.array(asked, dtype=np.int64)[~right].tolist():
        told[at] = FORGED
    return told


def check_signatures(messages: Messages, public_keys: Sequence[bytes]) -> BoolArray:
    """Return which of some signed messages are signed by the key of each, on all processors."""
    with needed("signing", "a signature"):
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415
    size = messages.dtype.itemsize
    content = messages.tobytes()
    end = size - CHECKSUM_BYTES - SIGNATURE_BYTES

    def check(numbers: range) -> list[bool]:
        return [
            _is_signed(
                Ed25519PublicKey.from_public_bytes(public_keys[number]),
                content[number * size + end : (number + 1) * size - CHECKSUM_BYTES],
                DOMAIN + content[number * size : number * size + end],
            )
            for number in numbers
        ]

    count = len(messages)
    some = [range(first, min(first + AT_ONCE, count)) for first in range(0, count, AT_ONCE)]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:  # checking lets others run
        found = [right for rights in threads.map(check, some) for right in rights]
    return np.array(found, dtype=np.bool_)


def _is_signed(key: "Ed25519PublicKey", signature: bytes, content: bytes) -> bool:
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415

    try:
        key.verify(signature, content)
    except InvalidSignature:
        return False
    return True


def _without_looking(layout: int, key: CarKey | None) -> str | None:
    if layout != SIGNED_LAYOUT:
        return UNSIGNED
    if key is None:
        return NO_KEY
    return REVOKED if key.revoked else None
