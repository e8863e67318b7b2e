"""One signature for what a car sends in a day, with which each message can be checked alone.

The messages are the leaves of a tree of SHA-256, in any order. As in RFC 6962 a leaf is the hash of
a zero byte and the message, a node that of a one byte and the two below it, so that no node is
taken for a message. The tree has a power of two leaves: those without a message are 32 zero bytes,
which are no known hash. The message is all before its place in the tree, with the layout and the
length that it is sent with.

The signature is over `DAY_DOMAIN`, the car (16 bytes), its day (days since 1970 in UTC, 4 bytes),
how many messages there are (2 bytes) and the root: a tree is of one car and one day. A car may sign
several in a day.
"""

from collections.abc import Sequence
from hashlib import sha256

from fleet_slip.grams.received.messages import (
    CHECKSUM_BYTES,
    NODE_BYTES,
    PLACE_BYTES,
    SIGNATURE_BYTES,
    Messages,
    levels_of,
)

DAY_DOMAIN = b"fleet-slip gram day\n"
DAY_S = 86_400
MOST_KEPT = 4096
"""Nodes that are not computed again for the next message."""
_LEAF, _NODE = b"\0", b"\1"
_VEHICLE, _START = slice(16, 32), slice(36, 44)
"""Where a message says which car it is of, and when its drive began."""


def levels_for(leaves: int) -> int:
    """Return the levels of a tree of so many messages."""
    return (leaves - 1).bit_length()


def car_and_day(message: bytes) -> tuple[bytes, int]:
    """Return the car of a message and the day on which its drive began, since 1970."""
    return message[_VEHICLE], int.from_bytes(message[_START], "little") // DAY_S


def claim_of(message: bytes, leaves: int, root: bytes) -> bytes | None:
    """Return what a car signs of the day of a message; None of a day that there is not."""
    vehicle, day = car_and_day(message)
    if day >= 2**32:
        return None
    return DAY_DOMAIN + vehicle + day.to_bytes(4, "little") + leaves.to_bytes(2, "little") + root


def grow(messages: Sequence[bytes]) -> tuple[bytes, list[bytes]]:
    """Return the root of a tree of messages, and the path of each."""
    nodes = [sha256(_LEAF + message).digest() for message in messages]
    nodes += [bytes(NODE_BYTES)] * (2 ** levels_for(len(messages)) - len(nodes))
    paths = [b""] * len(messages)
    level = 0
    while len(nodes) > 1:
        paths = [path + nodes[(at >> level) ^ 1] for at, path in enumerate(paths)]
        nodes = [sha256(_NODE + nodes[i] + nodes[i + 1]).digest() for i in range(0, len(nodes), 2)]
        level += 1
    return nodes[0], paths


def claims_of(messages: Messages) -> list[bytes | None]:
    """Return what the signature of each message must be over; None where no tree is like that."""
    levels, size = levels_of(messages) or 0, messages.dtype.itemsize
    end = size - CHECKSUM_BYTES - SIGNATURE_BYTES - NODE_BYTES * levels - PLACE_BYTES
    content = messages.tobytes()
    claims: list[bytes | None] = []
    above: dict[bytes, bytes] = {}
    places = zip(messages["leaf"].tolist(), messages["leaves"].tolist(), strict=True)
    for number, (leaf, leaves) in enumerate(places):
        if len(above) > MOST_KEPT:
            above.clear()
        message = content[number * size : number * size + end]
        beside = number * size + end + PLACE_BYTES
        node = sha256(_LEAF + message).digest()
        for level in range(levels):
            other = content[beside : beside + NODE_BYTES]
            two = other + node if leaf >> level & 1 else node + other
            if two not in above:
                above[two] = sha256(_NODE + two).digest()
            node = above[two]
            beside += NODE_BYTES
        there = leaf < leaves and levels == levels_for(leaves)
        claims.append(claim_of(message, leaves, node) if there else None)
    return claims
