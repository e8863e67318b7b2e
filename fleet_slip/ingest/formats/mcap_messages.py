"""Reads the records of MCAP files, and takes fields out of their messages."""

import json
from array import array
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.source import reading_with
from fleet_slip.words import shown

_LARGEST_RECORD, _LARGEST_RATIO = 2**27, 1000
"""Bytes of a record or of a chunk unpacked, and how many times its size a chunk may become."""
LARGEST_MESSAGE = 2**22
"""Bytes of a message that is decoded: each may become an object of its own."""
_MOST_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""

Decode = Callable[[bytes], Any]


def read_records(budget: Budget) -> Iterator[Any]:
    """Yield the records of a file; those in chunks come singly. Raises `InputError`."""
    path, unfolded = budget.file, 0
    with reading_with(path, "mcap.stream_reader") as mcap, path.open("rb") as file:
        reader = mcap.StreamReader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST_RECORD
        )
        for record in reader.records:
            if type(record).__name__ == "Chunk":
                chunk = _unpacked(path, record)
                unfolded += chunk.uncompressed_size
                budget.require_unfolded(unfolded)
                yield from mcap.breakup_chunk(chunk, validate_crc=True)
            else:
                yield record


def _unpacked(path: Path, chunk: Any) -> Any:
    """Return a chunk without compression: it may not become more than it says."""
    size, packed = chunk.uncompressed_size, len(chunk.data)
    if _LARGEST_RECORD < size <= _LARGEST_RATIO * packed:
        raise InputError(
            f"{shown(path)}: a chunk of it unfolds to {size:,} bytes; at most {_LARGEST_RECORD:,} "
            "are read at once. Write it again in smaller chunks, as rosbag2 does by default."
        )
    if size > _LARGEST_RATIO * max(packed, 1):
        raise InputError(
            f"{shown(path)}: a chunk of {packed:,} bytes says that it unfolds to "
            f"{size:,}: the file is damaged. Copy it again."
        )
    if chunk.compression:
        codec = {"zstd": "zstd", "lz4": "lz4"}[chunk.compression]
        chunk.data = pa.decompress(chunk.data, size, codec, asbytes=True)
        chunk.compression = ""
    return chunk


def decoder_of(channel: Any, schema: Any) -> Decode | None:
    """Return what decodes the messages of a channel, None if nothing does."""
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415 - of the extra `logs`

    if channel.message_encoding == "json":
        return json.loads
    decode: Decode | None = DecoderFactory().decoder_for(channel.message_encoding, schema)
    return decode


def stamp_s(message: Any, published_ns: int) -> float:
    """Return when a message was taken: as its header says, else when it was published."""
    stamp = field_of(message, "header.stamp") or field_of(message, "stamp")
    parts = [_attribute(stamp, name) for name in ("sec", "nanosec")]
    if all(isinstance(part, int) for part in parts) and any(parts):
        return float(parts[0]) + float(parts[1]) * 1e-9
    return published_ns * 1e-9


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
