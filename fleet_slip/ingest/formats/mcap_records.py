"""Reads the records of an MCAP file, all messages of a chunk together."""

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import reading_with
from fleet_slip.ingest.formats.mcap_fields import Block

_MESSAGE, _MESSAGE_INDEX = 5, 7
_RECORD, _HEAD = struct.Struct("<BQ"), struct.Struct("<BQH12xQ")
"""What begins a record; a message also says of which channel it is, and when it was published."""


def read_records(budget: Budget) -> Iterator[Any]:
    """Yield the records of a file, all messages of a chunk as a `Block` behind the others of it.

    Raises `InputError`.
    """
    path = budget.file
    with reading_with(path, "mcap.stream_reader") as mcap, path.open("rb") as file:

        class Reader(mcap.StreamReader):  # type: ignore[misc, name-defined]
            """Passes over indices: unpacking one takes as long as its messages."""

            def _read_record(self, opcode: int, length: int) -> Any:
                kind = 0 if opcode == _MESSAGE_INDEX else opcode  # which is unknown
                return super()._read_record(kind, length)

        reader = Reader(file, emit_chunks=True, validate_crcs=True, record_size_limit=None)
        for record in reader.records:
            if type(record).__name__ == "Chunk":
                stream, size = mcap.get_chunk_data_stream(record, validate_crc=True)
                block, others = _messages_in(stream.read(size))
                record.compression, record.data, record.uncompressed_crc = "", others, 0
                record.uncompressed_size = len(others)
                yield from mcap.breakup_chunk(record)
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
