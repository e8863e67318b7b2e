"""Looks at the containers of a BLF file and the lines of a trace, before python-can reads them.

It believes what they say: a container is unfolded whatever becomes of it, a line is read whatever
its length, and an object of no size is read for ever.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.words import shown

BLF_MAGIC = b"LOGG"
_MARK, _OBJECT = b"LOBJ", struct.Struct("<4s4xII")
"""What an object of BLF begins with: the mark, its size and its kind."""
_CONTAINER, _CONTAINER_HEADER = 10, struct.Struct("<16xH14x")
_COMPRESSED = 2
_LARGEST_CONTAINER, _LARGEST_OBJECT, _LONGEST_LINE = 2**27, 2**20, 2**20


def require_bounded(budget: Budget) -> None:
    """Raise `InputError` for a trace that is more than it seems. Raises `OSError`."""
    with budget.file.open("rb") as stream:
        if stream.read(len(BLF_MAGIC)) == BLF_MAGIC:
            _require_objects(stream, budget)
        else:
            stream.seek(0)
            _require_lines(stream, budget)


def _require_lines(stream: BinaryIO, budget: Budget) -> None:
    is_long = False
    while piece := stream.read(_LONGEST_LINE):
        if is_long and b"\n" not in piece:
            raise _damaged(budget, f"a line of more than {_LONGEST_LINE:,} bytes")
        is_long = b"\n" not in piece


def _require_objects(stream: BinaryIO, budget: Budget) -> None:
    """Look at all objects; one may continue in the next container."""
    unfolded, rest = 0, b""
    for container in _containers(stream, budget):
        unfolded += len(container)
        budget.require_unfolded(unfolded)
        content, at = rest + container, 0
        while (begin := content.find(_MARK, at, at + 8)) >= 0:
            if len(content) < begin + _OBJECT.size:
                break
            _, size, _ = _OBJECT.unpack_from(content, begin)
            if not _OBJECT.size <= size <= _LARGEST_OBJECT:
                raise _damaged(budget, f"an object of {size:,} bytes")
            if begin + size > len(content):
                break
            at = begin + size
        rest = content[at : at + _LARGEST_OBJECT]


def _containers(stream: BinaryIO, budget: Budget) -> Iterator[bytes]:
    """Yield the content of each container. What python-can finds wrong by itself ends them."""
    stream.seek(4)
    (at,) = struct.unpack("<I", stream.read(4).ljust(4, b"\0"))
    while len(header := os.pread(stream.fileno(), 32, at)) == _CONTAINER_HEADER.size:
        mark, size, kind = _OBJECT.unpack_from(header)
        if mark != _MARK:
            return
        if size < len(header):
            raise _damaged(budget, f"an object of {size:,} bytes")
        if kind == _CONTAINER:
            content = os.pread(stream.fileno(), size - len(header), at + len(header))
            if _CONTAINER_HEADER.unpack(header) == (_COMPRESSED,):
                try:
                    content = zlib.decompressobj().decompress(content, _LARGEST_CONTAINER + 1)
                except zlib.error:
                    return
            if len(content) > _LARGEST_CONTAINER:
                raise _damaged(budget, f"a container of more than {_LARGEST_CONTAINER:,} bytes")
            yield content
        at += size + size % 4


def _damaged(budget: Budget, what: str) -> InputError:
    return InputError(
        f"{shown(budget.file)}: {what}, which no trace has: it is damaged. Record or copy it again."
    )
