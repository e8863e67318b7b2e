"""Reads MCAP files: messages of ROS 2 (CDR), and of JSON. Each topic is a time base.

A column is `TOPIC.FIELD`, such as `/imu/data.linear_acceleration.y`, and `/joints.velocity[2]` of
an array. A message was taken when its header's stamp says, else when it was published.
"""

import json
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import describe_missing, shown
from fleet_slip.ingest.source import BASE, OWN_TIME, Channel, reading_with

MAGIC = b"\x89MCAP0\r\n"
MAX_MESSAGES = 20_000_000
_LARGEST_RECORD, _LARGEST_RATIO = 2**30, 1000
"""Bytes of a record or of a chunk unpacked, and how many times its size a chunk may become."""
_MOST_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""

_Decode = Callable[[bytes], Any]


class McapSource:
    """The topics of an MCAP file."""

    has_clock = True

    def __init__(self, file: Path) -> None:
        """Take the file's path."""
        self._file = file

    def channels(self) -> list[Channel]:
        """Return the numbers and texts in the first message of each topic."""
        return [
            Channel(f"{topic}.{field}", "", topic)
            for topic, (decode, messages) in self._topics.items()
            for field in self._fields(decode, messages[0][1])
        ]

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield one batch for each topic that has one of the columns."""
        wanted: dict[str, dict[str, str]] = defaultdict(dict)
        for column in columns:
            topics = [topic for topic in self._topics if column.startswith(f"{topic}.")]
            if not topics:
                names = [channel.name for channel in self.channels()]
                raise InputError(f"{shown(self._file)}: {describe_missing(column, names)}")
            topic = max(topics, key=len)
            wanted[topic][column] = column[len(topic) + 1 :]
        for topic, fields in wanted.items():
            yield self._read(topic, fields)

    def _read(self, topic: str, fields: dict[str, str]) -> pl.DataFrame:
        decode, messages = self._topics[topic]
        times_s: list[float] = []
        values: dict[str, list[Any]] = {column: [] for column in fields}
        with reading_with(self._file, "mcap"):
            for published_ns, data in messages:
                message = decode(data)
                times_s.append(_stamp_s(message, published_ns))
                for column, field in fields.items():
                    values[column].append(_get(message, field))
        frame = {OWN_TIME: pl.Series(times_s, dtype=pl.Float64)}
        for column, found in values.items():
            if all(value is None for value in found):
                names = [f"{topic}.{field}" for field in self._fields(decode, messages[0][1])]
                raise InputError(f"{shown(self._file)}: {describe_missing(column, names)}")
            frame[column] = self._column(column, found)
        return pl.DataFrame(frame).with_columns(pl.lit(topic).alias(BASE))

    @staticmethod
    def _column(name: str, values: list[Any]) -> pl.Series:
        if all(isinstance(value, int | float | None) for value in values):
            return pl.Series(name, values, pl.Float64, strict=False)
        return pl.Series(name, [None if v is None else str(v) for v in values], pl.String)

    def _fields(self, decode: _Decode, data: bytes) -> list[str]:
        with reading_with(self._file, "mcap"):
            return list(_leaves(decode(data)))

    @cached_property
    def _topics(self) -> dict[str, tuple[_Decode, list[tuple[int, bytes]]]]:
        """What decodes the messages of a topic; when they were published, and their bytes."""
        with reading_with(self._file, "mcap"):
            schemas: dict[int, Any] = {}
            channels: dict[int, Any] = {}
            messages: dict[int, list[tuple[int, bytes]]] = defaultdict(list)
            for number, record in enumerate(self._records()):
                if number > MAX_MESSAGES:
                    raise InputError(
                        f"{shown(self._file)}: more than {MAX_MESSAGES:,} messages. Split it."
                    )
                kind = type(record).__name__
                if kind == "Schema":
                    schemas[record.id] = record
                elif kind == "Channel":
                    channels[record.id] = record
                elif kind == "Message":
                    messages[record.channel_id].append((record.publish_time, record.data))
            found: dict[str, tuple[_Decode, list[tuple[int, bytes]]]] = {}
            for number, sent in messages.items():
                channel = channels[number]
                decode = _decoder(channel, schemas.get(channel.schema_id))
                if decode is not None:
                    before = found[channel.topic][1] if channel.topic in found else []
                    found[channel.topic] = (decode, before + sent)
        if not found:
            encodings = ", ".join(sorted({one.message_encoding for one in channels.values()}))
            raise InputError(
                f"{shown(self._file)}: no message in it can be decoded ({encodings or 'none'}). "
                "Read are ROS 2 messages (cdr with ros2msg schemas) and json."
            )
        return found

    def _records(self) -> Iterator[Any]:
        with reading_with(self._file, "mcap.stream_reader") as mcap, self._file.open("rb") as file:
            reader = mcap.StreamReader(
                file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST_RECORD
            )
            for record in reader.records:
                if type(record).__name__ == "Chunk":
                    yield from mcap.breakup_chunk(self._unpacked(record), validate_crc=True)
                else:
                    yield record

    def _unpacked(self, chunk: Any) -> Any:
        """Return a chunk without compression: it may not become more than it says."""
        size, packed = chunk.uncompressed_size, len(chunk.data)
        if size > min(_LARGEST_RECORD, _LARGEST_RATIO * max(packed, 1)):
            raise InputError(
                f"{shown(self._file)}: a chunk of {packed:,} bytes says that it unfolds to "
                f"{size:,}: the file is damaged. Copy it again."
            )
        if chunk.compression:
            codec = {"zstd": "zstd", "lz4": "lz4"}[chunk.compression]
            chunk.data = pa.decompress(chunk.data, size, codec, asbytes=True)
            chunk.compression = ""
        return chunk


def _decoder(channel: Any, schema: Any) -> _Decode | None:
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415 - of the extra `logs`

    if channel.message_encoding == "json":
        return json.loads
    decode: _Decode | None = DecoderFactory().decoder_for(channel.message_encoding, schema)
    return decode


def _stamp_s(message: Any, published_ns: int) -> float:
    stamp = _get(message, "header.stamp") or _get(message, "stamp")
    parts = [_attribute(stamp, name) for name in ("sec", "nanosec")]
    if all(isinstance(part, int) for part in parts) and any(parts):
        return float(parts[0]) + float(parts[1]) * 1e-9
    return published_ns * 1e-9


def _get(message: Any, path: str) -> Any:
    """Return a field of a field, or None if there is none; arrays by [number]."""
    for name in path.replace("[", ".[").split("."):
        if not name.startswith("["):
            message = _attribute(message, name)
        elif name[1:-1].isdecimal() and _is_array(message) and int(name[1:-1]) < len(message):
            message = message[int(name[1:-1])]
        else:
            return None
    return message


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


def _leaves(value: Any, path: str = "", depth: int = 0) -> Iterator[str]:
    """Yield the paths of the numbers and texts in a message."""
    if isinstance(value, bool | int | float | str):
        yield path
    elif _is_array(value):
        for number, item in enumerate(list(value)[:_MOST_ITEMS]):
            yield from _leaves(item, f"{path}[{number}]", depth + 1) if depth < _DEEPEST else ()
    elif depth < _DEEPEST:
        for name in _names(value):
            below = f"{path}.{name}" if path else name
            yield from _leaves(_attribute(value, name), below, depth + 1)


@contextmanager
def open_mcap(file: Path) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    yield McapSource(file)
