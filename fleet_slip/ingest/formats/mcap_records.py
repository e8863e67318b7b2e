"""Reads the records of an MCAP file, all messages of a chunk together."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import reading_with
from fleet_slip.ingest.formats.mcap_fields import Block
from fleet_slip.words import shown

MAGIC = b"\x89MCAP0\r\n"
_LARGEST_RECORD, _LARGEST_RATIO = 2**27, 1000
"""Bytes of a record or of a chunk unpacked, and how many times its size a chunk may become."""
_MESSAGE, _MESSAGE_INDEX = 5, 7
_RECORD, _HEAD = struct.Struct("<BQ"), struct.Struct("<BQH12xQ")
"""What begins a record; a message also says of which channel it is, and when it was published."""


def read_records(budget: Budget) -> Iterator[Any]:
    """Yield the records of a file, all messages of a chunk as a `Block` behind the others of it.

    Raises `InputError`.
    """
    path, unfolded = budget.file, 0
    with reading_with(path, "mcap.stream_reader") as mcap, path.open("rb") as file:

        class Reader(mcap.StreamReader):  # type: ignore[misc, name-defined]
            """Passes over indices: unpacking one takes as long as its messages."""

            def _read_record(self, opcode: int, length: int) -> Any:
                kind = 0 if opcode == _MESSAGE_INDEX else opcode  # which is unknown
                return super()._read_record(kind, length)

        reader = Reader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST_RECORD
        )
        for record in reader.records:
            if type(record).__name__ == "Chunk":
                chunk = _unpacked(path, record)
                unfolded += chunk.uncompressed_size
                budget.require_unfolded(unfolded)
                stream, size = mcap.get_chunk_data_stream(chunk, validate_crc=True)
                block, others = _messages_in(stream.read(size))
                chunk.data, chunk.uncompressed_size, chunk.uncompressed_crc = others, len(others), 0
                yield from mcap.breakup_chunk(chunk)
                yield block
                budget.meter.pass_over(file.tell(), budget.size)
            elif type(record).__name__ == "Message":
                heads = np.array([(record.channel_id, 0, len(record.data))])
                yield Block(record.data, heads, np.array([record.publish_time], np.uint64))
            else:
                yield record


def _messages_in(content: bytes) -> tuple[Block, bytes]:
    """Return the messages of a chunk, and its other records."""
    heads, published_ns, others, at = [], [], [], 0
    padded, last = content + bytes(_HEAD.size), len(content) - _RECORD.size
    while at <= last:
        kind, size, channel, moment_ns = _HEAD.unpack_from(padded, at)
        end = at + _RECORD.size + size
        if kind == _MESSAGE:
            heads.append((channel, at + _HEAD.size, end))
            published_ns.append(moment_ns)
        else:
            others.append(content[at:end])
        at = end
    messages = np.array(heads, np.int64).reshape(-1, 3)
    if at != len(content) or (messages[:, 1] > messages[:, 2]).any():
        raise EOFError("a record is cut off")
    return Block(content, messages, np.array(published_ns, np.uint64)), b"".join(others)


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
