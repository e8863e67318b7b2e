"""Looks how the blocks of an MDF file are linked, before asammdf follows the links.

It believes them. Groups and their channels are a tree: in a circle asammdf never ends, and what two
of them share it makes anew for each. Conversions may be shared, and be made of others; it makes all
of them anew for each channel.
"""

import os
import struct
from pathlib import Path

from fleet_slip.errors import InputError
from fleet_slip.words import shown

_FIRST, _VERSION = 64, 8
"""Where the header block is, and before it the version of the format."""
_TREE_4 = {
    b"##HD": (0, 1, 2, 3, 4), b"##DG": (0, 1, 2), b"##CG": (0, 1), b"##CN": (0, 1), b"##CA": (0,),
    b"##CH": (0, 1), b"##FH": (0,), b"##AT": (0,), b"##EV": (0,), b"##HL": (0,), b"##DL": (0,),
    b"##LD": (0,),
}  # fmt: skip
"""By kind of block, which of its links lead to blocks that nothing else links to (MDF 4)."""
_TREE_3 = {b"HD": (0,), b"DG": (0, 1), b"CG": (0, 1), b"CN": (0,)}
_CHANNEL, _ITS_CONVERSION = b"##CN", 4
_CONVERSION, _PARTS_FROM = b"##CC", 4
_MOST_PARTS = 10_000
"""Conversions that one is made of."""


def require_tree(file: Path) -> None:
    """Raise `InputError` for a file with links that cannot be followed. Raises `OSError`."""
    with file.open("rb") as stream:
        blocks = _Blocks(file, stream.fileno())
        waiting, seen = [_FIRST], set[int]()
        while waiting:
            at = waiting.pop()
            below = blocks.below(at)
            if below and at in seen:
                raise blocks.damaged(at, "is linked to twice")
            seen.add(at)
            waiting += [link for link in below if link]


class _Blocks:
    """The links in a file."""

    def __init__(self, file: Path, descriptor: int) -> None:
        self._file, self._descriptor = file, descriptor
        self._is_4 = os.pread(descriptor, 1, _VERSION) >= b"4"
        self._parts: dict[int, int] = {}

    def below(self, at: int) -> list[int]:
        """Return the links of a block that lead down the tree; none of one that is a leaf."""
        if not self._is_4:
            kind = os.pread(self._descriptor, 2, at)
            two = struct.unpack("<2I", os.pread(self._descriptor, 8, at + 4).ljust(8, b"\0"))
            return [two[number] for number in _TREE_3.get(kind, ())]
        kind, links = self._links_4(at)
        if kind == _CHANNEL and links[_ITS_CONVERSION]:
            self._count_parts(links[_ITS_CONVERSION], 0)
        return [links[number] for number in _TREE_4.get(kind, ())]

    def _links_4(self, at: int) -> tuple[bytes, list[int]]:
        """Return the kind of a block and its links; those of the first five that it lacks are 0."""
        header = os.pread(self._descriptor, 24, at).ljust(24, b"\0")
        kind, number = struct.unpack("<4s12xQ", header)
        links = os.pread(self._descriptor, 8 * min(number, _MOST_PARTS), at + 24)
        found = struct.unpack_from(f"<{len(links) // 8}Q", links)
        return kind, [link & (2**63 - 1) for link in (*found, 0, 0, 0, 0, 0)]

    def _count_parts(self, at: int, depth: int) -> int:
        """Return how many conversions one is made of, itself included."""
        if at not in self._parts:
            kind, links = self._links_4(at)
            parts = [link for link in links[_PARTS_FROM:] if link] if kind == _CONVERSION else []
            self._parts[at] = _MOST_PARTS  # for one that is a part of itself
            self._parts[at] = 1 + sum(self._count_parts(part, depth + 1) for part in parts)
        if self._parts[at] > _MOST_PARTS or depth > 100:
            raise self.damaged(at, f"is made of more than {_MOST_PARTS:,} conversions")
        return self._parts[at]

    def damaged(self, at: int, what: str) -> InputError:
        """Return what to say of a block."""
        return InputError(
            f"{shown(self._file)}: the block at byte {at:,} {what}: the file is damaged. Copy it "
            "again."
        )
