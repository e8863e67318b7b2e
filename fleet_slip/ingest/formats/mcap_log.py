"""Reads MCAP files: messages of ROS 2 (CDR), and of JSON. Each topic is a time base.

A column is `TOPIC.FIELD`, such as `/imu/data.linear_acceleration.y`, and `/joints.velocity[2]` of
an array. A message was taken when its header's stamp says, else when it was published. The file is
read once for what is in it, and once more for the columns that are asked for.
"""

import io
import json
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.source import (
    OWN_TIME,
    Base,
    Channel,
    ClockSource,
    describe_missing,
    reading_with,
)
from fleet_slip.ingest.logs.spool import Spool
from fleet_slip.words import shown

_LARGEST_RECORD, _LARGEST_RATIO = 2**27, 1000
"""Bytes of a record or of a chunk unpacked, and how many times its size a chunk may become."""
LARGEST_MESSAGE = 2**22
"""Bytes of a message that is decoded: each may become an object of its own."""
_MOST_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""

Decode = Callable[[bytes], Any]

MAGIC = b"\x89MCAP0\r\n"
PIECE_ROWS = 2**13
"""Messages of one topic that are in memory at once."""


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


_Fields = dict[str, str]
"""Paths of fields in the messages of one topic, by column."""


@dataclass
class _Rows:
    """Rows of one topic until they are put aside."""

    fields: _Fields
    times_s: list[float] = field(default_factory=list)
    values: list[list[Any]] = field(default_factory=list)


class McapSource(ClockSource):
    """The topics of an MCAP file."""

    def __init__(self, budget: Budget, spool: Spool) -> None:
        """Take the file and what it may become, and where decoded messages are kept."""
        self._file, self._budget, self._spool = budget.file, budget, spool
        self._kept: dict[str, _Fields] = {}
        self._rows: dict[str, int] = {}
        self._numbers: set[str] = set()
        self._texts: set[str] = set()

    def channels(self) -> list[Channel]:
        """Return the numbers and texts in the first message of each topic."""
        return [
            Channel(f"{topic}.{name}", "", topic)
            for topic, names in self._topics.items()
            for name in names
        ]

    def bases(self, columns: Sequence[str]) -> list[Base]:
        """Return the topics that have one of the columns. Raises `InputError`."""
        wanted: dict[str, _Fields] = defaultdict(dict)
        for column in columns:
            topics = [topic for topic in self._topics if column.startswith(f"{topic}.")]
            if not topics:
                raise self._missing(column, [channel.name for channel in self.channels()])
            topic = max(topics, key=len)
            wanted[topic][column] = column[len(topic) + 1 :]
        if any(not of.keys() <= self._kept.get(topic, {}).keys() for topic, of in wanted.items()):
            self._keep(wanted)
        for topic, of in wanted.items():
            for column in of.keys() - self._numbers - self._texts:
                raise self._missing(column, [f"{topic}.{name}" for name in self._topics[topic]])
        return [
            Base(topic, partial(self._rows.__getitem__, topic), partial(self._read, topic, [*of]))
            for topic, of in wanted.items()
        ]

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield the rows of each topic with one of the columns; all topics are read at once."""
        if not self._kept:
            self._keep({t: {f"{t}.{name}": name for name in of} for t, of in self._topics.items()})
        yield from super().batches(columns)

    def _missing(self, column: str, names: list[str]) -> InputError:
        return InputError(f"{shown(self._file)}: {describe_missing(column, names)}")

    @cached_property
    def _topics(self) -> dict[str, list[str]]:
        """The fields of the first message of each topic that can be decoded."""
        found: dict[str, list[str]] = {}
        encodings = set()
        with reading_with(self._file, "mcap"):
            for channel, decode, message in self._messages():
                encodings.add(channel.message_encoding)
                if len(message.data) > LARGEST_MESSAGE:
                    continue
                if decode is not None and channel.topic not in found:
                    found[channel.topic] = list(leaves_of(decode(message.data)))
        if not found:
            raise InputError(
                f"{shown(self._file)}: no message in it can be decoded "
                f"({', '.join(sorted(encodings)) or 'none'}). Read are ROS 2 messages (cdr with "
                "ros2msg schemas) and json."
            )
        return found

    def _messages(self) -> Iterator[tuple[Any, Decode | None, Any]]:
        """Yield all messages, in the file's order, with their channels and what decodes them."""
        schemas: dict[int, Any] = {}
        channels: dict[int, tuple[Any, Decode | None]] = {}
        messages = 0
        for record in read_records(self._budget):
            kind = type(record).__name__
            if kind == "Message":
                messages += 1
                self._budget.require_rows(messages)
                yield *channels[record.channel_id], record
            elif kind == "Schema":
                schemas[record.id] = record
            elif kind == "Channel" and record.id not in channels:
                channels[record.id] = record, decoder_of(record, schemas.get(record.schema_id))

    def _keep(self, wanted: dict[str, _Fields]) -> None:
        """Decode columns of some topics, and put them aside."""
        self._kept, self._texts = wanted, set()
        while not self._decode(wanted):
            pass

    def _decode(self, wanted: dict[str, _Fields]) -> bool:
        """Put columns aside; return False if one of them, all numbers so far, has a text."""
        self._spool.clear()
        self._rows, self._numbers = dict.fromkeys(wanted, 0), set()
        coming = {topic: _Rows(fields) for topic, fields in wanted.items()}
        with reading_with(self._file, "mcap"):
            for channel, decode, message in self._messages():
                rows = coming.get(channel.topic)
                if rows is None or decode is None:
                    continue
                if len(message.data) > LARGEST_MESSAGE:
                    raise InputError(
                        f"{shown(self._file)}: a message of {channel.topic!r} has "
                        f"{len(message.data):,} bytes; at most {LARGEST_MESSAGE:,} are decoded."
                    )
                found = decode(message.data)
                rows.times_s.append(stamp_s(found, message.publish_time))
                rows.values.append([field_of(found, name) for name in rows.fields.values()])
                if len(rows.times_s) >= PIECE_ROWS:
                    coming[channel.topic] = self._put_aside(channel.topic, rows)
                    if self._numbers & self._texts:
                        return False
            for topic, rows in coming.items():
                self._put_aside(topic, rows)
        return not self._numbers & self._texts

    def _put_aside(self, topic: str, rows: _Rows) -> _Rows:
        """Put rows aside; return room for more."""
        frame = {OWN_TIME: pl.Series(rows.times_s, dtype=pl.Float64)}
        columns = zip(*rows.values, strict=True) if rows.values else [()] * len(rows.fields)
        for column, values in zip(rows.fields, columns, strict=True):
            frame[column] = self._column(column, values)
        content = io.BytesIO()
        pl.DataFrame(frame).write_ipc_stream(content)
        self._spool.add(topic, content.getvalue())
        self._rows[topic] += len(rows.times_s)
        return _Rows(rows.fields)

    def _column(self, column: str, values: Sequence[Any]) -> pl.Series:
        """Return some values of a column: all of it are numbers, or texts."""
        some = [value for value in values if value is not None]
        if column not in self._texts and all(isinstance(value, int | float) for value in some):
            self._numbers |= {column} if some else set()
            return pl.Series(values, dtype=pl.Float64, strict=False)
        self._texts.add(column)
        return pl.Series([None if v is None else str(v) for v in values], dtype=pl.String)

    def _read(self, topic: str, columns: list[str]) -> Iterator[pl.DataFrame]:
        texts = [pl.col(column).cast(pl.String) for column in columns if column in self._texts]
        for piece in self._spool.read(topic):
            yield pl.read_ipc_stream(piece).select(OWN_TIME, *columns).with_columns(texts)


@contextmanager
def open_mcap(budget: Budget) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    with closing(Spool()) as spool:
        yield McapSource(budget, spool)
