"""The fields of MCAP messages: of one message, and of many that are alike at once.

Where in a message a number stands is learned from the decoder: each byte of one message is changed
in turn, and what changes in what is decoded tells whose it is. Another message of the same length,
whose other bytes are the same (texts, lengths of arrays), has its numbers at the same places.
"""

import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray, IntArray

Decode = Callable[[bytes], Any]
_MOST_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""
_LONGEST, _MOST_SHAPES = 1024, 8
"""Bytes of a message whose shape is learned, and shapes of a topic."""
_CHANGES = (0x01, 0x80, 0xFF)
_FAILURES = (
    ValueError, TypeError, IndexError, EOFError, OverflowError, MemoryError, NotImplementedError,
    struct.error,
)  # fmt: skip
"""What the decoder raises for a message that is none."""


@dataclass(frozen=True)
class Block:
    """Some messages.

    Attributes:
        content: bytes in which they stand.
        heads: of each its channel, where its data begin and where they end, shape (m, 3).
        published_ns: when each was published, shape (m,).
    """

    content: bytes
    heads: IntArray
    published_ns: NDArray[np.uint64]

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.heads)

    def of(self, channels: Sequence[int]) -> "Block":
        """Return the messages of some channels."""
        mine = np.isin(self.heads[:, 0], channels)
        return Block(self.content, self.heads[mine], self.published_ns[mine])

    def one_by_one(self) -> Iterator[tuple[int, bytes, int]]:
        """Yield the channel, the data and the moment of each message."""
        told = zip(self.heads.tolist(), self.published_ns.tolist(), strict=True)
        for (channel, begin, end), published_ns in told:
            yield channel, self.content[begin:end], published_ns


def stamp_s(message: Any, published_ns: int) -> float:
    """Return when a message was taken: as its header says, else when it was published."""
    parts = [field_of(message, name) for name in _stamp_of(message)]
    if all(isinstance(part, int) for part in parts) and any(parts):
        return float(parts[0]) + float(parts[1]) * 1e-9
    return published_ns * 1e-9


def _stamp_of(message: Any) -> list[str]:
    """Return the names of the two fields that would tell when a message was taken."""
    stamp = "header.stamp" if field_of(message, "header.stamp") else "stamp"
    return [f"{stamp}.{name}" for name in ("sec", "nanosec")]


def field_of(message: Any, path: str) -> Any:
    """Return a field of a field, or None if there is none; arrays by [number]."""
    for name in _steps(path):
        if not name.startswith("["):
            message = _attribute(message, name)
        elif name[1:-1].isdecimal() and _is_array(message) and int(name[1:-1]) < len(message):
            message = message[int(name[1:-1])]
        else:
            return None
    return message


@lru_cache(maxsize=10_000)
def _steps(path: str) -> tuple[str, ...]:
    return tuple(path.replace("[", ".[").split("."))


def _attribute(message: Any, name: str) -> Any:
    if isinstance(message, dict):
        return message.get(name)
    return getattr(message, name, None) if name in _names(message) else None


def _names(message: Any) -> Sequence[str]:
    if isinstance(message, dict):
        return [str(name) for name in message]
    names: Sequence[str] = getattr(type(message), "__slots__", ())
    return names


def _is_array(value: Any) -> bool:
    return isinstance(value, list | tuple | array)


def leaves_of(value: Any, path: str = "", depth: int = 0) -> Iterator[str]:
    """Yield the paths of the numbers and texts in a message."""
    if isinstance(value, bool | int | float | str):
        yield path
    elif _is_array(value):
        for number, item in enumerate(list(value)[:_MOST_ITEMS]):
            yield from leaves_of(item, f"{path}[{number}]", depth + 1) if depth < _DEEPEST else ()
    elif depth < _DEEPEST:
        for name in _names(value):
            below = f"{path}.{name}" if path else name
            yield from leaves_of(_attribute(value, name), below, depth + 1)


@dataclass(frozen=True)
class _Shape:
    """Where numbers stand in messages like one.

    Attributes:
        example: its bytes.
        fixed: which of them must be the same.
        numbers: the type and the place of each number, by its path.
        stamp: the paths of seconds and nanoseconds of its stamp; none without any.
    """

    example: NDArray[np.uint8]
    fixed: NDArray[np.bool_]
    numbers: dict[str, tuple[np.dtype[Any], int]]
    stamp: list[str]


class AlikeMessages:
    """The shapes of messages, learned as they come."""

    def __init__(self) -> None:
        """Begin without any."""
        self._shapes: dict[tuple[str, int], list[_Shape | None]] = defaultdict(list)

    def read(
        self, decode: Decode, topic: str, names: Sequence[str], block: Block
    ) -> list[FloatArray] | None:
        """Return the times in s and the columns of messages, if they are all alike."""
        channels, begins, ends = block.heads.T
        size = int(ends[0] - begins[0])
        if size > _LONGEST or (ends - begins != size).any() or (channels != channels[0]).any():
            return None
        content = np.frombuffer(block.content, np.uint8)
        data = content[begins[:, np.newaxis] + np.arange(size)]
        shapes = self._shapes[topic, size]
        fits = (one for one in shapes if one and _is_alike(one, data))
        shape = next(fits, None)
        if shape is None and len(shapes) < _MOST_SHAPES:
            shape = _learn(decode, data[0].tobytes())
            shapes.append(shape)
        if shape is None or not shape.numbers.keys() >= set(names) or not _is_alike(shape, data):
            return None
        times_s: FloatArray = block.published_ns.astype(np.float64) * 1e-9
        if shape.stamp:
            seconds, nanoseconds = (_numbers(shape, data, name) for name in shape.stamp)
            known = (seconds != 0) | (nanoseconds != 0)
            times_s = np.where(known, seconds + nanoseconds * 1e-9, times_s)
        return [times_s, *(_numbers(shape, data, name) for name in names)]


def _is_alike(shape: _Shape, data: NDArray[np.uint8]) -> bool:
    return bool((data[:, shape.fixed] == shape.example[shape.fixed]).all())


def _numbers(shape: _Shape, data: NDArray[np.uint8], name: str) -> FloatArray:
    kind, at = shape.numbers[name]
    some = np.ascontiguousarray(data[:, at : at + kind.itemsize])
    return some.view(kind)[:, 0].astype(np.float64)


def _learn(decode: Decode, example: bytes) -> _Shape | None:
    """Return where numbers stand in a message; None if its stamp is none of them."""
    message = decode(example)
    plain = _values(decode, example)
    if not plain:
        return None
    fixed = np.zeros(len(example), dtype=np.bool_)
    seen: dict[str, list[tuple[int, bytes, Any]]] = defaultdict(list)
    for at in range(len(example)):
        changed = bytearray(example)
        owners: set[str] = set()
        found = []
        for change in _CHANGES:
            changed[at] = example[at] ^ change
            values = _values(decode, bytes(changed))
            if values is None or values.keys() != plain.keys():
                owners |= plain.keys() | {""}
                break
            mine = [name for name, value in values.items() if repr(value) != repr(plain[name])]
            owners.update(mine)
            found += [(at, bytes(changed), values[name]) for name in mine]
        fixed[at] = len(owners) > 1
        if len(owners) == 1:
            seen[owners.pop()] += found
    numbers = {}
    for name, some in seen.items():
        places = sorted({at for at, *_ in some})
        kind = _kind_of(places, some)
        if kind is not None:
            numbers[name] = kind, places[0]
        elif len(places) > 1 or not isinstance(plain[name], bool):
            fixed[places] = True
    parts = [field_of(message, name) for name in _stamp_of(message)]
    stamp = _stamp_of(message) if all(isinstance(part, int) for part in parts) else []
    if any(name not in numbers for name in stamp):
        return None
    return _Shape(np.frombuffer(example, np.uint8), fixed, numbers, stamp)


def _values(decode: Decode, message: bytes) -> dict[str, Any] | None:
    """Return the numbers and texts of a message by their paths; None if it is none."""
    try:
        found = decode(message)
        return {name: field_of(found, name) for name in leaves_of(found)}
    except _FAILURES:
        return None


def _kind_of(places: Sequence[int], seen: Sequence[tuple[int, bytes, Any]]) -> np.dtype[Any] | None:
    """Return the type of a number of these bytes, by what it was when they were changed."""
    first, size = places[0], len(places)
    types = {type(value) for *_, value in seen}
    if places[-1] - first + 1 != size or types not in ({int}, {float}):
        return None
    for letter in "f" if types == {float} else "iu":
        for order in "<>":
            try:
                kind = np.dtype(f"{order}{letter}{size}")
            except TypeError:
                continue
            told = [np.frombuffer(content, kind, 1, first)[0].item() for _, content, _ in seen]
            if all(repr(a) == repr(value) for a, (*_, value) in zip(told, seen, strict=True)):
                return kind
    return None
