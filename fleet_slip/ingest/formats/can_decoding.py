"""Takes signals out of the payloads of many CAN frames at once.

The meaning of start bit, byte order and multiplexing is that of the DBC format, as cantools parses
it; its own decoder, one frame at a time, is what the tests compare with.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray

Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

MOST_BYTES = 64
"""Bytes of a frame of CAN FD."""
_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}


def is_possible(signal: Any) -> bool:
    """Whether a frame can have a signal: at most 64 bits in 64 bytes, floats of their sizes."""
    if not 0 <= signal.start < 8 * MOST_BYTES or not 1 <= signal.length <= 64:
        return False
    return needed_bytes(signal) <= MOST_BYTES and (not signal.is_float or signal.length in _FLOATS)


def needed_bytes(signal: Any) -> int:
    """Return how long a payload must be to hold a signal."""
    return max(byte for byte, _ in _bits(signal)) + 1


def raw_integers(signal: Any, payloads: Bytes) -> NDArray[np.uint64]:
    """Return a signal's bits as unsigned integers; payloads have shape (frames, bytes)."""
    value = np.zeros(len(payloads), dtype=np.uint64)
    for place, (byte, bit) in enumerate(_bits(signal)):
        value |= ((payloads[:, byte] >> bit) & 1).astype(np.uint64) << np.uint64(place)
    return value


def raw_numbers(signal: Any, payloads: Bytes) -> NDArray[Any]:
    """Return a signal as it was sent: integers, signed if it is, or floats."""
    value = raw_integers(signal, payloads)
    if signal.is_float:
        whole = value.astype(f"u{signal.length // 8}")
        return whole.view(_FLOATS[signal.length]).astype(np.float64)
    if not signal.is_signed:
        return value
    shift = np.int64(64 - signal.length)
    return (value << shift.astype(np.uint64)).view(np.int64) >> shift


def physical(signal: Any, raw: NDArray[Any]) -> FloatArray:
    """Return scale times raw plus offset."""
    scale, offset = float(signal.scale), float(signal.offset)
    return np.asarray(raw.astype(np.float64) * scale + offset, dtype=np.float64)


def is_sent(message: Any, signal: Any, payloads: Bytes) -> Flags:
    """Return in which frames a multiplexed signal is; in all, if it is not multiplexed."""
    sent = np.ones(len(payloads), dtype=np.bool_)
    while signal.multiplexer_ids is not None:
        selector = message.get_signal_by_name(signal.multiplexer_signal)
        sent &= np.isin(raw_integers(selector, payloads), list(signal.multiplexer_ids))
        signal = selector
    return sent


def _bits(signal: Any) -> list[tuple[int, int]]:
    """Return (byte, bit) of each bit of a signal, the least significant first."""
    if signal.byte_order == "little_endian":
        return [divmod(signal.start + i, 8) for i in range(signal.length)]
    # The start is the most significant bit; from there down to bit 0, then bit 7 of the next byte.
    first = 8 * (signal.start // 8) + 7 - signal.start % 8
    places = range(first + signal.length - 1, first - 1, -1)
    return [(place // 8, 7 - place % 8) for place in places]
