"""Reads MCAP files: messages of ROS 2 (CDR), and of JSON. Each topic is a time base.

A column is `TOPIC.FIELD`, such as `/imu/data.linear_acceleration.y`, and `/joints.velocity[2]` of
an array. A message was taken when its header's stamp says, else when it was published. The file is
read once for what is in it, and once more for the columns that are asked for.
"""

import io
import json
import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.base import shown
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.source import (
    OWN_TIME,
    Budget,
    Channel,
    FormatSource,
    Spool,
    missing_column,
    reading_with,
)

# The fields of MCAP messages: of one message, and of many that are alike at once.
#
# Where in a message a number stands is learned from the decoder: each byte of one message is
# changed in turn, and what changes in what is decoded tells whose it is. Another message of the
# same length, whose other bytes are the same (texts, lengths of arrays), has its numbers at the
# same places.

Decode = Callable[[bytes], Any]
_MOST_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""
_LONGEST, _MOST_SHAPES = 1024, 8
"""Bytes of a message whose shape is learned, and shapes of a topic."""
_CHANGES = (0x01, 0x80, 0xFF)
_FAILURES = (
    ValueError, TypeError, IndexError, EOFError, OverflowError, MemoryError, NotImplementedError,
    struct.error,
)  # fmt: skip
"""What the decoder raises for a message that is none."""


@dataclass(frozen=True)
class Block:
    """Some messages.

    Attributes:
        content: bytes in which they stand.
        heads: of each its channel, where its data begin and where they end, shape (m, 3).
        published_ns: when each was published, shape (m,).
    """

    content: bytes
    heads: IntArray
    published_ns: NDArray[np.uint64]

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.heads)

    def of(self, channels: Sequence[int]) -> "Block":
        """Return the messages of some channels."""
        mine = np.isin(self.heads[:, 0], channels)
        return Block(self.content, self.heads[mine], self.published_ns[mine])

    def one_by_one(self) -> Iterator[tuple[int, bytes, int]]:
        """Yield the channel, the data and the moment of each message."""
        told = zip(self.heads.tolist(), self.published_ns.tolist(), strict=True)
        for (channel, begin, end), published_ns in told:
            yield channel, self.content[begin:end], published_ns


def stamp_s(message: Any, published_ns: int) -> float:
    """Return when a message was taken: as its header says, else when it was published."""
    parts = [field_of(message, name) for name in _stamp_of(message)]
    if all(isinstance(part, int) for part in parts) and any(parts):
        return float(parts[0]) + float(parts[1]) * 1e-9
    return published_ns * 1e-9


def _stamp_of(message: Any) -> list[str]:
    """Return the names of the two fields that would tell when a message was taken."""
    stamp = "header.stamp" if field_of(message, "header.stamp") else "stamp"
    return [f"{stamp}.{name}" for name in ("sec", "nanosec")]


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


@dataclass(frozen=True)
class _Shape:
    """Where numbers stand in messages like one.

    Attributes:
        example: its bytes.
        fixed: which of them must be the same.
        numbers: the type and the place of each number, by its path.
        stamp: the paths of seconds and nanoseconds of its stamp; none without any.
    """

    example: NDArray[np.uint8]
    fixed: NDArray[np.bool_]
    numbers: dict[str, tuple[np.dtype[Any], int]]
    stamp: list[str]


class AlikeMessages:
    """The shapes of messages, learned as they come."""

    def __init__(self) -> None:
        """Begin without any."""
        self._shapes: dict[tuple[str, int], list[_Shape | None]] = defaultdict(list)

    def read(
        self, decode: Decode, topic: str, names: Sequence[str], block: Block
    ) -> list[FloatArray] | None:
        """Return the times in s and the columns of messages, if they are all alike."""
        channels, begins, ends = block.heads.T
        size = int(ends[0] - begins[0])
        if size > _LONGEST or (ends - begins != size).any() or (channels != channels[0]).any():
            return None
        content = np.frombuffer(block.content, np.uint8)
        data = content[begins[:, np.newaxis] + np.arange(size)]
        shapes = self._shapes[topic, size]
        fits = (one for one in shapes if one and _is_alike(one, data))
        shape = next(fits, None)
        if shape is None and len(shapes) < _MOST_SHAPES:
            shape = _learn(decode, data[0].tobytes())
            shapes.append(shape)
        if shape is None or not shape.numbers.keys() >= set(names) or not _is_alike(shape, data):
            return None
        times_s: FloatArray = block.published_ns.astype(np.float64) * 1e-9
        if shape.stamp:
            seconds, nanoseconds = (_numbers(shape, data, name) for name in shape.stamp)
            known = (seconds != 0) | (nanoseconds != 0)
            times_s = np.where(known, seconds + nanoseconds * 1e-9, times_s)
        return [times_s, *(_numbers(shape, data, name) for name in names)]


def _is_alike(shape: _Shape, data: NDArray[np.uint8]) -> bool:
    return bool((data[:, shape.fixed] == shape.example[shape.fixed]).all())


def _numbers(shape: _Shape, data: NDArray[np.uint8], name: str) -> FloatArray:
    kind, at = shape.numbers[name]
    some = np.ascontiguousarray(data[:, at : at + kind.itemsize])
    return some.view(kind)[:, 0].astype(np.float64)


def _learn(decode: Decode, example: bytes) -> _Shape | None:
    """Return where numbers stand in a message; None if its stamp is none of them."""
    message = decode(example)
    plain = _values(decode, example)
    if not plain:
        return None
    fixed = np.zeros(len(example), dtype=np.bool_)
    seen: dict[str, list[tuple[int, bytes, Any]]] = defaultdict(list)
    for at in range(len(example)):
        changed = bytearray(example)
        owners: set[str] = set()
        found = []
        for change in _CHANGES:
            changed[at] = example[at] ^ change
            values = _values(decode, bytes(changed))
            if values is None or values.keys() != plain.keys():
                owners |= plain.keys() | {""}
                break
            mine = [name for name, value in values.items() if repr(value) != repr(plain[name])]
            owners.update(mine)
            found += [(at, bytes(changed), values[name]) for name in mine]
        fixed[at] = len(owners) > 1
        if len(owners) == 1:
            seen[owners.pop()] += found
    numbers = {}
    for name, some in seen.items():
        places = sorted({at for at, *_ in some})
        kind = _kind_of(places, some)
        if kind is not None:
            numbers[name] = kind, places[0]
        elif len(places) > 1 or not isinstance(plain[name], bool):
            fixed[places] = True
    parts = [field_of(message, name) for name in _stamp_of(message)]
    stamp = _stamp_of(message) if all(isinstance(part, int) for part in parts) else []
    if any(name not in numbers for name in stamp):
        return None
    return _Shape(np.frombuffer(example, np.uint8), fixed, numbers, stamp)


def _values(decode: Decode, message: bytes) -> dict[str, Any] | None:
    """Return the numbers and texts of a message by their paths; None if it is none."""
    try:
        found = decode(message)
        return {name: field_of(found, name) for name in leaves_of(found)}
    except _FAILURES:
        return None


def _kind_of(places: Sequence[int], seen: Sequence[tuple[int, bytes, Any]]) -> np.dtype[Any] | None:
    """Return the type of a number of these bytes, by what it was when they were changed."""
    first, size = places[0], len(places)
    types = {type(value) for *_, value in seen}
    if places[-1] - first + 1 != size or types not in ({int}, {float}):
        return None
    for letter in "f" if types == {float} else "iu":
        for order in "<>":
            try:
                kind = np.dtype(f"{order}{letter}{size}")
            except TypeError:
                continue
            told = [np.frombuffer(content, kind, 1, first)[0].item() for _, content, _ in seen]
            if all(repr(a) == repr(value) for a, (*_, value) in zip(told, seen, strict=True)):
                return kind
    return None


# Reads the records of an MCAP file, all messages of a chunk together.

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


PIECE_ROWS = 2**13
"""Messages of one topic that are in memory at once."""


def decoder_of(channel: Any, schema: Any) -> Decode | None:
    """Return what decodes the messages of a channel, None if nothing does."""
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415 - of the extra `logs`

    if channel.message_encoding == "json":
        return json.loads
    decode: Decode | None = DecoderFactory().decoder_for(channel.message_encoding, schema)
    if decode is None:
        return None

    def decode_plain(data: bytes) -> Any:
        # The decoder reads any other as this one too, with its numbers at wrong places.
        if data[:2] not in {b"\0\0", b"\0\1"}:
            raise ValueError(f"a message is not plain CDR (it begins with {data[:2].hex()})")
        return decode(data)

    return decode_plain


_Fields = dict[str, str]
"""Paths of fields in the messages of one topic, by column."""
_Channels = dict[int, tuple[Any, Decode | None]]
"""Channels by their number, with what decodes their messages."""


@dataclass
class _Rows:
    """Rows of one topic until they are put aside."""

    fields: _Fields
    times_s: list[float] = field(default_factory=list)
    values: list[list[Any]] = field(default_factory=list)


class McapSource(FormatSource):
    """The topics of an MCAP file."""

    def __init__(self, budget: Budget, spool: Spool) -> None:
        """Take the file and what it may become, and where decoded messages are kept."""
        self._file, self._budget, self._spool = budget.file, budget, spool
        self._kept: dict[str, _Fields] = {}
        self._rows: dict[str, int] = {}
        self._numbers: set[str] = set()
        self._texts: set[str] = set()
        self._alike = AlikeMessages()

    def channels(self) -> list[Channel]:
        """Return the numbers and texts in the first message of each topic."""
        return [
            Channel(f"{topic}.{name}", "", topic)
            for topic, names in self._topics.items()
            for name in names
        ]

    def find(self, column: str) -> tuple[str, str]:
        """Return a topic, and the path of a field. Raises `InputError`."""
        topics = [topic for topic in self._topics if column.startswith(f"{topic}.")]
        if not topics:
            raise missing_column(self._file, column, [one.name for one in self.channels()])
        topic = max(topics, key=len)
        return topic, column[len(topic) + 1 :]

    def prepare(self, wanted: dict[str, _Fields]) -> None:
        """Decode columns and put them aside, unless they are. Raises `InputError`."""
        if any(not of.keys() <= self._kept.get(topic, {}).keys() for topic, of in wanted.items()):
            self._kept, self._texts = {}, set()
            while not self._decode(wanted):
                pass
            self._kept = wanted
        for topic, of in wanted.items():
            for column in of.keys() - self._numbers - self._texts:
                names = [f"{topic}.{name}" for name in self._topics[topic]]
                raise missing_column(self._file, column, names)

    def count(self, topic: str, _found: _Fields) -> int:
        """Return how many messages a topic has."""
        return self._rows[topic]

    def read(self, topic: str, found: _Fields) -> Iterator[pl.DataFrame]:
        """Yield fields of a topic."""
        texts = [pl.col(column).cast(pl.String) for column in found if column in self._texts]
        for piece in self._spool.read(topic):
            yield pl.read_ipc_stream(piece).select(OWN_TIME, *found).with_columns(texts)

    @cached_property
    def _topics(self) -> dict[str, list[str]]:
        """The fields of the first message of each topic that can be decoded."""
        found: dict[str, list[str]] = {}
        encodings: set[str] = set()
        done: set[int] = set()
        with reading_with(self._file, "mcap"):
            for channels, block in self._blocks():
                for number in set(block.heads[:, 0].tolist()) - done:
                    channel, decode = channels[number]
                    encodings.add(channel.message_encoding)
                    _, data, _ = next(block.of([number]).one_by_one())
                    done.add(number)
                    if decode is not None and channel.topic not in found:
                        found[channel.topic] = list(leaves_of(decode(data)))
        if not found:
            raise InputError(
                f"{shown(self._file)}: no message in it can be decoded "
                f"({', '.join(sorted(encodings)) or 'none'}). Read are ROS 2 messages (cdr with "
                "ros2msg schemas) and json."
            )
        return found

    def _blocks(self) -> Iterator[tuple[_Channels, Block]]:
        """Yield all messages, in the file's order, with their channels and what decodes them."""
        schemas: dict[int, Any] = {}
        channels: _Channels = {}
        for record in read_records(self._budget):
            kind = type(record).__name__
            if kind == "Block":
                yield channels, record
            elif kind == "Schema":
                schemas[record.id] = record
            elif kind == "Channel" and record.id not in channels:
                channels[record.id] = record, decoder_of(record, schemas.get(record.schema_id))

    def _decode(self, wanted: dict[str, _Fields]) -> bool:
        """Put columns aside; return False if one of them, all numbers so far, has a text."""
        self._spool.clear()
        self._rows, self._numbers = dict.fromkeys(wanted, 0), set()
        coming = {topic: _Rows(fields) for topic, fields in wanted.items()}
        with reading_with(self._file, "mcap"):
            for channels, block in self._blocks():
                by_topic: dict[str, list[int]] = defaultdict(list)
                for number in np.unique(block.heads[:, 0]).tolist():
                    by_topic[channels[number][0].topic].append(number)
                for topic in coming.keys() & by_topic.keys():
                    some = block.of(by_topic[topic])
                    coming[topic] = self._take(topic, coming[topic], some, channels)
                    if self._numbers & self._texts:
                        return False
            for topic, rows in coming.items():
                self._put_aside(topic, rows)
        return not self._numbers & self._texts

    def _take(self, topic: str, rows: _Rows, block: Block, channels: _Channels) -> _Rows:
        """Decode messages of a topic, many at once where they are alike; return what waits."""
        channel, decode = channels[int(block.heads[0, 0])]
        if channel.message_encoding == "cdr" and decode is not None:
            found = self._alike.read(decode, topic, [*rows.fields.values()], block)
            if found is not None and not self._texts.intersection(rows.fields):
                rows = self._put_aside(topic, rows)
                self._numbers.update(rows.fields)
                columns = zip([OWN_TIME, *rows.fields], found, strict=True)
                self._write(topic, pl.DataFrame(dict(columns)))
                return rows
        for number, data, published_ns in block.one_by_one():
            channel, decode = channels[number]
            if decode is None:
                raise InputError(
                    f"{shown(self._file)}: topic {topic!r} has a channel that nothing decodes "
                    f"({channel.message_encoding!r}) beside one that is read. Record it in one "
                    "encoding, or map another topic."
                )
            message = decode(data)
            rows.times_s.append(stamp_s(message, published_ns))
            rows.values.append([field_of(message, name) for name in rows.fields.values()])
            if len(rows.times_s) >= PIECE_ROWS:
                rows = self._put_aside(topic, rows)
        return rows

    def _put_aside(self, topic: str, rows: _Rows) -> _Rows:
        """Put rows aside; return room for more."""
        if not rows.times_s and self._rows[topic]:
            return rows
        frame = {OWN_TIME: pl.Series(rows.times_s, dtype=pl.Float64)}
        columns = zip(*rows.values, strict=True) if rows.values else [()] * len(rows.fields)
        for column, values in zip(rows.fields, columns, strict=True):
            frame[column] = self._column(column, values)
        self._write(topic, pl.DataFrame(frame))
        return _Rows(rows.fields)

    def _write(self, topic: str, rows: pl.DataFrame) -> None:
        content = io.BytesIO()
        rows.write_ipc_stream(content)
        self._spool.add(topic, content.getvalue())
        self._rows[topic] += len(rows)

    def _column(self, column: str, values: Sequence[Any]) -> pl.Series:
        """Return some values of a column: all of it are numbers, or texts."""
        some = [value for value in values if value is not None]
        if column not in self._texts and all(isinstance(value, int | float) for value in some):
            self._numbers |= {column} if some else set()
            return pl.Series(values, dtype=pl.Float64, strict=False)
        self._texts.add(column)
        return pl.Series([None if v is None else str(v) for v in values], dtype=pl.String)


@contextmanager
def open_mcap(budget: Budget) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    with closing(Spool()) as spool:
        yield McapSource(budget, spool)
