"""The CAN frames of a BLF file, as arrays: some containers of objects at a time.

Nobody published the format; it is as python-can reads it (after Toby Lorenz's Vector BLF), frame by
frame and a hundred times slower, which the tests compare with. A file may say what it likes: sizes
are looked at before anything is unfolded or read.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from itertools import product
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.can.can_frames import MOST_BYTES, Bytes, FrameBlock

MAGIC = b"LOGG"
_MARK, _OBJECT = b"LOBJ", struct.Struct("<4s4xII")
"""What an object begins with: the mark, its size and its kind."""
_MARKS = re.compile(_MARK)
_CONTAINER, _CONTAINER_HEADER = 10, struct.Struct("<16xH14x")
_PLAIN, _COMPRESSED = 0, 2
_LARGEST_OBJECT, _PADDING = 2**20, 4
_REACH = len(_MARK) + _PADDING
_AT_ONCE = 2**22
"""Bytes of containers that are read together."""

_HEADERS = {1: 32, 2: 40}
"""Bytes of an object's header, by its version."""
_HEADER = {"version": ("<u2", 6), "size": ("<u4", 8), "kind": ("<u4", 12)}
_TIMED = {"flags": ("<u4", 16), "time": ("<u8", 24)}
"""What begins every object, and what more a header has: the types of fields, and where."""


class _Kind(NamedTuple):
    """What follows the header in a kind of frame."""

    fields: dict[str, tuple[str, int]]
    """Types and places of fields; `further` is where other data follow, if not at the end."""
    size: int
    remote: int
    """The bit in `how` of a frame that asks for data and has none."""


_CLASSIC = _Kind(
    {"bus": ("<u2", 0), "how": ("u1", 2), "length": ("u1", 3), "number": ("<u4", 4)}
    | {"data": ("8u1", 8)},
    size=16,
    remote=0x80,
)
_FD = _Kind(
    {"bus": ("<u2", 0), "how": ("u1", 2), "number": ("<u4", 4), "length": ("u1", 14)}
    | {"data": ("64u1", 20)},
    size=84,
    remote=0x80,
)
_FD_64 = _Kind(
    {"bus": ("u1", 0), "length": ("u1", 2), "number": ("<u4", 4), "how": ("<u4", 12)}
    | {"further": ("u1", 35)},
    size=40,
    remote=0x10,
)
_KINDS = {1: _CLASSIC, 86: _CLASSIC, 100: _FD, 101: _FD_64}
_EXTENDED, _IDENTIFIER, _TENS_OF_US = 1 << 31, (1 << 29) - 1, 1
_NONE = np.empty(0, dtype=np.int64)
_NOTHING = FrameBlock(_NONE, _NONE > 0, _NONE / 1.0, _NONE, _NONE, np.empty((0, 0), dtype=np.uint8))


def read_blf_frames(budget: Budget, start_s: float) -> Iterator[FrameBlock]:
    """Yield the data frames of a file that begins at `start_s`; all other objects are passed over.

    Raises `InputError` for a file that is damaged or more than it seems, and `OSError`.
    """
    rest = b""
    with budget.file.open("rb") as stream:
        for some in _together(_containers(stream, budget)):
            content = rest + some
            begins, end = _objects(content, budget)
            rest = content[end:]
            if len(begins):
                yield _frames(content, begins, start_s, budget)
    if _MARK in rest:
        raise budget.damaged("a last object that ends too early")


def _together(containers: Iterator[bytes]) -> Iterator[bytes]:
    """Yield contents that are long enough for what it costs to look at one."""
    some: list[bytes] = []
    for container in containers:
        some.append(container)
        if sum(map(len, some)) >= _AT_ONCE:
            yield b"".join(some)
            some = []
    yield b"".join(some)


def _containers(stream: BinaryIO, budget: Budget) -> Iterator[bytes]:
    """Yield the content of each container."""
    stream.seek(len(MAGIC))
    (at,) = struct.unpack("<I", stream.read(4).ljust(4, b"\0"))
    while header := os.pread(stream.fileno(), _CONTAINER_HEADER.size, at):
        mark, size, kind = _OBJECT.unpack_from(header.ljust(_CONTAINER_HEADER.size))
        if mark != _MARK or len(header) < _CONTAINER_HEADER.size:
            raise budget.damaged(f"no object at byte {at:,}")
        if size < len(header):
            raise budget.damaged(f"an object of {size:,} bytes")
        if kind == _CONTAINER:
            content = os.pread(stream.fileno(), size - len(header), at + len(header))
            if len(content) < size - len(header):
                raise budget.damaged("a container that ends too early")
            yield _unfolded(content, _CONTAINER_HEADER.unpack(header)[0], budget)
        at += size + size % _PADDING
        budget.meter.pass_over(at, budget.size)


def _unfolded(content: bytes, method: int, budget: Budget) -> bytes:
    if method == _COMPRESSED:
        try:
            return zlib.decompress(content)
        except zlib.error as error:
            raise budget.damaged(f"a container that zlib cannot unfold ({error})") from None
    if method != _PLAIN:
        raise budget.damaged(f"a container compressed by an unknown method, {method}")
    return content


def _objects(content: bytes, budget: Budget) -> tuple[IntArray, int]:
    """Return where whole objects begin, and where the last of them ends.

    Marks are all objects, if each stands where the object before it ends; where one is among data,
    objects are sought one after the other.
    """
    begins = np.array([found.start() for found in _MARKS.finditer(content)], dtype=np.int64)
    begins = begins[begins <= len(content) - _OBJECT.size]
    sizes = _read(np.frombuffer(content, np.uint8), begins, _HEADER, _OBJECT.size)["size"]
    ends = begins + sizes
    gaps = begins - np.concatenate([[0], ends[:-1]])
    possible = (sizes >= _OBJECT.size) & (sizes <= _LARGEST_OBJECT)
    if (possible & (gaps >= 0) & (gaps <= _PADDING)).all():
        begins = begins[ends <= len(content)]
        end = int(ends[len(begins) - 1]) if len(begins) else 0
    else:
        begins, end = _seek_objects(content, budget)
    left = content[end : end + _REACH]
    if len(left) == _REACH and _MARK not in left:
        raise budget.damaged("no object where the next should begin")
    return begins, end


def _seek_objects(content: bytes, budget: Budget) -> tuple[IntArray, int]:
    """Do what `_objects` does, from object to object."""
    begins: list[int] = []
    at = 0
    while (begin := content.find(_MARK, at, at + _REACH)) >= 0:
        if len(content) < begin + _OBJECT.size:
            break
        _, size, _ = _OBJECT.unpack_from(content, begin)
        if not _OBJECT.size <= size <= _LARGEST_OBJECT:
            raise budget.damaged(f"an object of {size:,} bytes")
        if begin + size > len(content):
            break
        begins.append(begin)
        at = begin + size
    return np.array(begins, dtype=np.int64), at


def _frames(content: bytes, begins: IntArray, start_s: float, budget: Budget) -> FrameBlock:
    """Return the data frames among some objects, in their order."""
    data = np.frombuffer(content, dtype=np.uint8)
    heads = _read(data, begins, _HEADER, _OBJECT.size)
    blocks, places = [_NOTHING], [_NONE]
    for (number, kind), (version, header) in product(_KINDS.items(), _HEADERS.items()):
        at = np.flatnonzero((heads["kind"] == number) & (heads["version"] == version))
        if not len(at):
            continue
        least, size = heads["size"][at].min(), header + kind.size
        if least < size:
            raise budget.damaged(f"a frame of {least} bytes")
        fields = {name: (form, header + place) for name, (form, place) in kind.fields.items()}
        found = _read(data, begins[at], _TIMED | fields, size)
        if "data" in fields:
            payloads = found["data"]
        else:
            ends = np.where(found["further"] > 0, found["further"], heads["size"][at])
            payloads = _data_behind(data, begins[at] + size, ends.astype(np.int64) - size)
        numbers = found["number"].astype(np.int64)
        block = FrameBlock(
            numbers & _IDENTIFIER,
            numbers & _EXTENDED != 0,
            found["time"] / np.where(found["flags"] == _TENS_OF_US, 1e5, 1e9) + start_s,
            found["bus"].astype(np.int64) - 1,
            np.minimum(found["length"].astype(np.int64), payloads.shape[1]),
            payloads,
        )
        sent = found["how"] & kind.remote == 0
        blocks.append(block.where(sent))
        places.append(at[sent])
    return _joined(blocks).where(np.argsort(np.concatenate(places), kind="stable"))


def _joined(blocks: list[FrameBlock]) -> FrameBlock:
    """Return several blocks as one."""
    widest = max(block.data.shape[1] for block in blocks)
    columns = list(zip(*(vars(block).values() for block in blocks), strict=True))
    columns[-1] = tuple(np.pad(data, ((0, 0), (0, widest - data.shape[1]))) for data in columns[-1])
    return FrameBlock(*map(np.concatenate, columns))


def _data_behind(data: Bytes, starts: IntArray, there: IntArray) -> Bytes:
    """Return the data at some places; where too little is there, zeros, as CANoe reads it."""
    found: Bytes = sliding_window_view(np.pad(data, (0, MOST_BYTES)), MOST_BYTES)[starts]
    found[np.arange(MOST_BYTES) >= there[:, np.newaxis]] = 0
    return found


def _read(
    data: Bytes, begins: IntArray, fields: dict[str, tuple[str, int]], size: int
) -> NDArray[Any]:
    """Return fields of so many bytes at some places."""
    formats, offsets = zip(*fields.values(), strict=True)
    kind = np.dtype(
        {"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size}
    )
    if not len(begins):  # perhaps there is not even room for one
        return np.empty(0, dtype=kind)
    records: NDArray[Any] = sliding_window_view(data, size)[begins].view(kind)[:, 0]
    return records
