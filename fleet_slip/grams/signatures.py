"""Signatures of messages: Ed25519, by the car's gateway, over all that stands before them.

A signed message has the layout 2: it is 64 bytes longer, which stand before its checksum. The
signature is over `DOMAIN` and all bytes before it.
"""

import zlib
from collections.abc import Iterator

from fleet_slip.errors import InputError
from fleet_slip.extras import needed
from fleet_slip.grams.car_keys import CarKey, CarKeys
from fleet_slip.grams.messages import (
    CHECKSUM_BYTES,
    SIGNATURE_BYTES,
    SIGNED_LAYOUT,
    read_messages,
)
from fleet_slip.grams.received_rows import ReceivedRows

DOMAIN = b"fleet-slip gram message\n"
"""Before what is signed: the same key signs nothing else that could be taken for a message."""

UNSIGNED = "is not signed"
NO_KEY = "is of a car that had no key on that day"
REVOKED = "is signed by a key that was revoked"
FORGED = "is not signed by the key of its car"


def sign_messages(content: bytes, private_key: bytes) -> bytes:
    """Return messages that stand one behind the other, each signed.

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


def judge_signatures(rows: ReceivedRows, keys: CarKeys) -> Iterator[str | None]:
    """Yield why each message is not to be believed; None where the key of its car signed it."""
    with needed("signing", "a signature"):
        from cryptography.exceptions import InvalidSignature  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415
    layout = int(rows.messages["layout"][0])
    cars, days = rows.vehicle_ids.to_pylist(), rows.days.to_pylist()
    for message, car, day in zip(rows.messages, cars, days, strict=True):
        key = keys.of(car, day)
        if (told := _without_looking(layout, key)) or key is None:
            yield told
            continue
        content = message.tobytes()
        end = len(content) - CHECKSUM_BYTES - SIGNATURE_BYTES
        try:
            Ed25519PublicKey.from_public_bytes(key.bytes).verify(
                content[end:-CHECKSUM_BYTES], DOMAIN + content[:end]
            )
        except InvalidSignature:
            yield FORGED
        else:
            yield None


def _without_looking(layout: int, key: CarKey | None) -> str | None:
    if layout != SIGNED_LAYOUT:
        return UNSIGNED
    if key is None:
        return NO_KEY
    return REVOKED if key.revoked else None
