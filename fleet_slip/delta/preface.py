"""Parts of bytes that stand in a Parquet file before its rows, each with a checksum of its own.

    PAR1 | FSPF, layout, number of parts; length and XXH3 of each; XXH3 of all this | parts | rows …

Parquet finds its rows from the end of a file, so that every reader passes over what stands here, as
over a Bloom filter. It is one file with its rows: it is committed, found, checked and deleted with
them. The first bytes of a file tell it, without the others.
"""

import struct
from collections.abc import Sequence

import xxhash

from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder

_PARQUET = b"PAR1"
_MAGIC = b"FSPF"
_LAYOUT = 1
_HEAD = struct.Struct("<4sHH")
_PART = struct.Struct("<QQ")
_CHECKSUM = struct.Struct("<Q")

FIRST_BYTES = 2**17
"""So much of a file is read at first: with it, mostly, the part that is wanted."""


def pack_preface(parts: Sequence[bytes]) -> bytes:
    """Return what stands before the rows of a file that has some parts."""
    told = [_PART.pack(len(part), xxhash.xxh3_64_intdigest(part)) for part in parts]
    head = _HEAD.pack(_MAGIC, _LAYOUT, len(parts)) + b"".join(told)
    return head + _CHECKSUM.pack(xxhash.xxh3_64_intdigest(head)) + b"".join(parts)


def read_preface(folder: Folder, path: str, wanted: int) -> bytes | None:
    """Return one of the parts, from 0, before the rows of a file; None for a file without any.

    A preface of a layout that is not known is none. Raises `StorageError` if the part is not what
    was written.
    """
    content = folder.read(path, FIRST_BYTES)
    places = _places(content, f"{folder}/{path}")
    if wanted >= len(places):
        return None
    start, length, checksum = places[wanted]
    if start + length > len(content):
        content = folder.read(path, start + length)
    part = content[start : start + length]
    if xxhash.xxh3_64_intdigest(part) != checksum:
        raise _damaged(f"{folder}/{path}")
    return part


def _places(content: bytes, where: str) -> list[tuple[int, int, int]]:
    """Return where each part begins, its length and its checksum."""
    if not content.startswith(_PARQUET + _MAGIC) or len(content) < len(_PARQUET) + _HEAD.size:
        return []
    begin = len(_PARQUET)
    _, layout, count = _HEAD.unpack_from(content, begin)
    if layout != _LAYOUT:
        return []
    stop = begin + _HEAD.size + count * _PART.size
    start = stop + _CHECKSUM.size
    if start > len(content):
        raise _damaged(where)
    if _CHECKSUM.unpack_from(content, stop) != (xxhash.xxh3_64_intdigest(content[begin:stop]),):
        raise _damaged(where)
    places = []
    for length, checksum in _PART.iter_unpack(content[begin + _HEAD.size : stop]):
        places.append((start, length, checksum))
        start += length
    return places


def _damaged(where: str) -> StorageError:
    return StorageError(
        f"{where}: what stands before its rows does not match its checksum: the file was damaged. "
        "See what can be repaired with: fleet-slip verify --repair; or restore it from a backup."
    )
