"""Looks how the blocks of an MDF file are linked, before a package follows the links.

Channels of groups of groups of data are a tree. asammdf walks along its links and believes them: in
a circle it never ends, and what two groups share it makes anew for each.
"""

import os
import struct
from pathlib import Path

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.columns import shown

_FIRST, _VERSION = 64, 8
"""Where the header block is, and before it the version of the format."""
_LINKS_4 = {
    b"##HD": (0, 1, 2, 3, 4), b"##DG": (0, 1, 2), b"##CG": (0, 1), b"##CN": (0, 1), b"##CA": (0,),
    b"##CH": (0, 1), b"##FH": (0,), b"##AT": (0,), b"##EV": (0,), b"##HL": (0,), b"##DL": (0,),
    b"##LD": (0,),
}  # fmt: skip
"""By kind of block, which of its links lead to blocks that nothing else links to (MDF 4)."""
_LINKS_3 = {b"HD": (0,), b"DG": (0, 1), b"CG": (0, 1), b"CN": (0,)}


def require_tree(file: Path) -> None:
    """Raise `InputError` if a block of an MDF file is linked to twice. Raises `OSError`."""
    with file.open("rb") as stream:
        descriptor = stream.fileno()
        is_4 = os.pread(descriptor, 1, _VERSION) >= b"4"
        waiting, seen = [_FIRST], set[int]()
        while waiting:
            at = waiting.pop()
            links = (_links_4 if is_4 else _links_3)(descriptor, at)
            if links and at in seen:
                raise InputError(
                    f"{shown(file)}: the block at byte {at:,} is linked to twice: the file is "
                    "damaged. Copy it again."
                )
            seen.add(at)
            waiting += [link for link in links if link]


def _links_4(descriptor: int, at: int) -> tuple[int, ...]:
    """Return the links of a block to others of the tree; none of one that is a leaf."""
    kind = os.pread(descriptor, 4, at)
    content = os.pread(descriptor, 8 * 5, at + 24)
    return tuple(
        int(struct.unpack_from("<Q", content, 8 * number)[0]) & (2**63 - 1)
        for number in _LINKS_4.get(kind, ())
        if len(content) >= 8 * number + 8
    )


def _links_3(descriptor: int, at: int) -> tuple[int, ...]:
    kind = os.pread(descriptor, 2, at)
    content = os.pread(descriptor, 4 * 2, at + 4)
    return tuple(
        int(struct.unpack_from("<I", content, 4 * number)[0])
        for number in _LINKS_3.get(kind, ())
        if len(content) >= 4 * number + 4
    )
