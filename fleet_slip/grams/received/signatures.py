"""Signatures of messages.

A signed message has the layout 2, of a feature set 4: it is 64 bytes longer, which stand before
its checksum. The Ed25519 signature, made by the car's gateway, is over `DOMAIN` and all bytes
before it. Checking one takes longer than all else; one for a whole day (`day_tree`) is checked
once.
"""

import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import InputError
from fleet_slip.extras import needed
from fleet_slip.grams.received.car_keys import CarKeys
from fleet_slip.grams.received.day_tree import (
    car_and_day,
    claim_of,
    claims_of,
    grow,
    levels_for,
)
from fleet_slip.grams.received.found_messages import read_messages
from fleet_slip.grams.received.messages import (
    CHECKSUM_BYTES,
    DAY_LAYOUTS,
    MOST_LEVELS,
    NODE_BYTES,
    PLACE_BYTES,
    SIGNATURE_BYTES,
    SIGNED_LAYOUTS,
    Messages,
    is_signed,
    levels_of,
)
from fleet_slip.grams.received.received_rows import ReceivedRows
from fleet_slip.words import shown

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

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
    key = _private_key(private_key)
    signed = []
    for plain, message in _unsigned(content):
        body = _renamed(message, SIGNED_LAYOUTS[plain], SIGNATURE_BYTES)
        signed.append(_with_checksum(body + key.sign(DOMAIN + body)))
    return b"".join(signed)


def sign_days(content: bytes, private_key: bytes) -> bytes:
    """Sign the messages that stand one behind the other by one signature for each car and day.

    They stand by car and day then, of more than 1,024 in several trees. As `sign_messages` else;
    raises `InputError` also for a drive whose day cannot be written in 4 bytes.
    """
    key = _private_key(private_key)
    days: dict[tuple[bytes, int], list[tuple[int, bytes]]] = {}
    for plain, message in _unsigned(content):
        days.setdefault(car_and_day(message), []).append((plain, message))
    signed = []
    for whole in days.values():
        for first in range(0, len(whole), 2**MOST_LEVELS):
            some = whole[first : first + 2**MOST_LEVELS]
            levels = levels_for(len(some))
            more = PLACE_BYTES + NODE_BYTES * levels + SIGNATURE_BYTES
            bodies = [_renamed(one, DAY_LAYOUTS[plain] + levels, more) for plain, one in some]
            root, paths = grow(bodies)
            claim = claim_of(bodies[0], len(some), root)
            if claim is None:
                raise InputError(_no_day(bodies[0]))
            signature = key.sign(claim)
            for leaf, (body, path) in enumerate(zip(bodies, paths, strict=True)):
                place = leaf.to_bytes(2, "little") + len(some).to_bytes(2, "little")
                signed.append(_with_checksum(body + place + path + signature))
    return b"".join(signed)


def _no_day(message: bytes) -> str:
    vehicle, day = car_and_day(message)
    name = shown(vehicle.rstrip(b"\0").decode(errors="replace"))
    return f"a drive of {name} begins {day:,} days after 1970: nothing is signed. Mend its clock."


def _private_key(private_key: bytes) -> "Ed25519PrivateKey":
    with needed("signing", "a signature"):
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415
        from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415
    try:
        key = load_pem_private_key(private_key, password=None)
    except (ValueError, TypeError):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        raise InputError("the key is not an unencrypted Ed25519 private key in PEM.")
    return key


def _unsigned(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the layout and the bytes of sound messages, without checksums."""
    found = read_messages(content)
    if found.refused:
        number, reason = found.refused[0]
        raise InputError(f"message {number} {reason}: nothing is signed.")
    for first, messages in found.runs:
        if is_signed(messages):
            raise InputError(f"message {first} is signed already.")
        for message in messages:
            yield int(message["layout"]), message.tobytes()[:-CHECKSUM_BYTES]


def _renamed(message: bytes, layout: int, more: int) -> bytes:
    """Return a message, without its checksum, of another layout and so many bytes more."""
    size = len(message) + more + CHECKSUM_BYTES
    return message[:4] + layout.to_bytes(2, "little") + size.to_bytes(2, "little") + message[8:]


def _with_checksum(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(CHECKSUM_BYTES, "little")


def judge_signatures(rows: ReceivedRows, keys: CarKeys) -> list[str | None]:
    """Return why each message is refused; None where the key of its car signed it."""
    if not is_signed(rows.messages):
        return [UNSIGNED] * len(rows)
    cars, days = rows.vehicle_ids.to_pylist(), rows.days.to_pylist()
    known = [keys.of(car, day) for car, day in zip(cars, days, strict=True)]
    told = [NO_KEY if key is None else REVOKED if key.revoked_since else None for key in known]
    asked = [at for at, why in enumerate(told) if why is None]
    public = [key.bytes for at in asked if (key := known[at])]
    right = check_signatures(rows.messages[asked], public)
    for at in np.array(asked, dtype=np.int64)[~right].tolist():
        told[at] = FORGED
    return told


def check_signatures(messages: Messages, public_keys: Sequence[bytes]) -> BoolArray:
    """Return which of some signed messages are signed by the key of each, on all processors.

    A signature of several is checked once.
    """
    content, size = messages.tobytes(), messages.dtype.itemsize
    end = size - CHECKSUM_BYTES - SIGNATURE_BYTES
    starts = range(0, len(content), size)
    if levels_of(messages) is None:
        claims: list[bytes | None] = [DOMAIN + content[at : at + end] for at in starts]
    else:
        claims = claims_of(messages)
    signatures = [content[at + end : at + end + SIGNATURE_BYTES] for at in starts]
    asked = list(zip(public_keys, signatures, claims, strict=True))
    once = list(dict.fromkeys(asked))
    parts = [once[at : at + AT_ONCE] for at in range(0, len(once), AT_ONCE)]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:  # checking lets others run
        right = {one for some in threads.map(_signed_ones, parts) for one in some}
    return np.array([one in right for one in asked], dtype=np.bool_)


_Claim = tuple[bytes, bytes, bytes | None]
"""A public key, a signature and what it must be over."""


def _signed_ones(claims: Iterable[_Claim]) -> list[_Claim]:
    """Return those of some claims that their keys signed."""
    with needed("signing", "a signature"):
        from cryptography.exceptions import InvalidSignature  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415
    found = []
    for one in claims:
        key, signature, claim = one
        with suppress(InvalidSignature):
            if claim is not None:
                Ed25519PublicKey.from_public_bytes(key).verify(signature, claim)
                found.append(one)
    return found
