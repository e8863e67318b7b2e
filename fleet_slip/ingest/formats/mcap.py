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
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
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
    load_library,
    missing_column,
)

Decode = Callable[[bytes], Any]
_MOST_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""


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
        heads = zip(self.heads.tolist(), self.published_ns.tolist(), strict=True)
        for (channel, begin, end), published_ns in heads:
            yield channel, self.content[begin:end], published_ns


def leaves_of(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the numbers and texts in a message, with their paths."""
    if isinstance(value, bool | int | float | str):
        yield path, value
    elif depth < _DEEPEST:
        below: list[tuple[str, Any]]
        if isinstance(value, list | tuple | array):
            below = [(f"[{number}]", item) for number, item in enumerate(value[:_MOST_ITEMS])]
        else:
            names = value if isinstance(value, dict) else getattr(type(value), "__slots__", ())
            of = value if isinstance(value, dict) else {n: getattr(value, n) for n in names}
            below = [(f".{name}" if path else str(name), of[name]) for name in names]
        for name, item in below:
            yield from leaves_of(item, path + name, depth + 1)


def stamp_of(fields: dict[str, Any]) -> list[str]:
    """Return the paths of seconds and nanoseconds at which a message was taken, if it says so."""
    for stamp in ("header.stamp", "stamp"):
        paths = [f"{stamp}.sec", f"{stamp}.nanosec"]
        if all(isinstance(fields.get(path), int) for path in paths):
            return paths
    return []


def stamp_s(fields: dict[str, Any], published_ns: int) -> float:
    """Return when a message was taken: as its header says, else when it was published."""
    parts = [fields[path] for path in stamp_of(fields)]
    return float(parts[0]) + float(parts[1]) * 1e-9 if any(parts) else published_ns * 1e-9


# Where the numbers of a ROS message are follows from its definition, and from the lengths of the
# texts and arrays in it. Messages of a channel with the same lengths are read at once.

_LONGEST, _MOST_LAYOUTS = 1024, 8
"""Bytes of a message whose layout is computed, and layouts of a channel's messages of one size."""
_KINDS = {
    "byte": "u1", "char": "i1", "uint8": "u1", "int8": "i1", "uint16": "u2", "int16": "i2",
    "uint32": "u4", "int32": "i4", "uint64": "u8", "int64": "i8", "float32": "f4", "float64": "f8",
}  # fmt: skip


class _Layout:
    """Where numbers are in messages like one: of what type, and at which byte, by their paths."""

    def __init__(self, schema: Any, decode: Decode, data: bytes) -> None:
        """Take a definition and a message. Raises what the decoder does, or `ValueError`."""
        from mcap_ros2 import _dynamic as ros  # noqa: PLC0415 - of the extra `logs`

        time = ros.TimeDefinition
        self._types = {f"builtin_interfaces/{name}": time for name in ("Time", "Duration")}
        ros._for_each_msgdef(
            schema.name,
            schema.data.decode(),
            lambda name, short, of: self._types.update({name: of, short: of}),
        )
        self._data, self._at, self._order = data, 4, "><"[data[1] & 1]
        self._fixed = [0, 1, 2, 3]
        self.numbers: dict[str, tuple[np.dtype[Any], int]] = {}
        self._message(self._types[schema.name], "")
        fields = dict(leaves_of(decode(data)))
        if self._at > len(data) or any(
            repr(fields[path]) != repr(np.frombuffer(data, kind, 1, at)[0].item())
            for path, (kind, at) in self.numbers.items()
            if path in fields
        ):
            raise ValueError("it is decoded in another way")
        self.stamp = stamp_of(fields)
        self._lengths = np.frombuffer(data, np.uint8)[self._fixed]

    def _message(self, definition: Any, above: str) -> None:
        self._at += not definition.fields  # then it has a byte that means nothing
        for field in definition.fields:
            path, kind = f"{above}.{field.name}" if above else field.name, field.type
            if not kind.is_array:
                self._value(kind, path)
                continue
            items = kind.array_size if kind.is_fixed_size_array() else self._length()
            if kind.type in {"byte", "uint8"}:  # decoded as bytes, which are no columns
                self._at += items
                continue
            for number in range(items):
                self._value(kind, f"{path}[{number}]")

    def _value(self, kind: Any, path: str) -> None:
        if self._at > len(self._data):
            raise ValueError("it ends too early")
        if not kind.is_primitive_type():
            self._message(self._types[f"{kind.pkg_name}/{kind.type}"], path)
        elif kind.type == "string":
            size = self._length()
            self._at += size
        elif kind.type == "bool":
            self._at += 1
        else:
            dtype = np.dtype(self._order + _KINDS[kind.type])
            self._align(dtype.itemsize)
            self.numbers[path] = dtype, self._at
            self._at += dtype.itemsize

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % size

    def _length(self) -> int:
        """Return the length of a text or an array, which must be the same in all messages."""
        self._align(4)
        self._fixed += range(self._at, self._at + 4)
        self._at += 4
        length = self._data[self._at - 4 : self._at]
        return int.from_bytes(length, "little" if self._order == "<" else "big")

    def fits(self, data: NDArray[np.uint8]) -> bool:
        """Whether messages, of the same size, have the same lengths."""
        return bool((data[:, self._fixed] == self._lengths).all())

    def column(self, data: NDArray[np.uint8], path: str) -> FloatArray:
        """Return a number of each message."""
        kind, at = self.numbers[path]
        some = np.ascontiguousarray(data[:, at : at + kind.itemsize])
        return some.view(kind)[:, 0].astype(np.float64)


class RosMessages:
    """The messages of one channel of ROS, read at once where they are alike."""

    def __init__(self, schema: Any, decode: Decode) -> None:
        """Take their definition, and what decodes one."""
        self._schema, self._decode = schema, decode
        self._layouts: dict[int, list[_Layout | None]] = defaultdict(list)

    def read(self, names: Sequence[str], block: Block) -> list[FloatArray] | None:
        """Return the times in s and the columns of messages, if they are all alike."""
        _, begins, ends = block.heads.T
        size = int(ends[0] - begins[0])
        if size > _LONGEST or (ends - begins != size).any():
            return None
        content = np.frombuffer(block.content, np.uint8)
        data = content[begins[:, np.newaxis] + np.arange(size)]
        layouts = self._layouts[size]
        layout = next((one for one in layouts if one and one.fits(data)), None)
        if layout is None and len(layouts) < _MOST_LAYOUTS:
            with suppress(*_FAILURES):
                layout = _Layout(self._schema, self._decode, data[0].tobytes())
            layouts.append(layout)
        if layout is None or not layout.fits(data):
            return None
        if not layout.numbers.keys() >= {*names, *layout.stamp}:
            return None
        times_s: FloatArray = block.published_ns.astype(np.float64) * 1e-9
        if layout.stamp:
            seconds, nanoseconds = (layout.column(data, name) for name in layout.stamp)
            known = (seconds != 0) | (nanoseconds != 0)
            times_s = np.where(known, seconds + nanoseconds * 1e-9, times_s)
        return [times_s, *(layout.column(data, name) for name in names)]


_FAILURES = (
    ValueError, TypeError, LookupError, EOFError, OverflowError, NotImplementedError, struct.error,
)  # fmt: skip
"""What the decoder raises for a message that is none."""


# Reads the records of an MCAP file, all messages of a chunk together.

PIECE_ROWS = 2**13
"""Messages outside of chunks that are read at once."""

_MESSAGE, _MESSAGE_INDEX = 5, 7
_RECORD, _HEAD = struct.Struct("<BQ"), struct.Struct("<BQH12xQ")
"""What begins a record; a message also says of which channel it is, and when it was published."""


def read_records(budget: Budget) -> Iterator[Any]:
    """Yield the records of a file, all messages of a chunk as a `Block` behind the others of it.

    Raises `InputError`.
    """
    path = budget.file
    mcap = load_library(path, "mcap.stream_reader")
    with path.open("rb") as file:

        class Reader(mcap.StreamReader):  # type: ignore[misc, name-defined]
            """Passes over indices: unpacking one takes as long as its messages."""

            def _read_record(self, opcode: int, length: int) -> Any:
                kind = 0 if opcode == _MESSAGE_INDEX else opcode  # which is unknown
                return super()._read_record(kind, length)

        reader = Reader(file, emit_chunks=True, validate_crcs=True, record_size_limit=None)
        alone: list[Any] = []
        for record in reader.records:
            kind = type(record).__name__
            if alone and (kind != "Message" or len(alone) >= PIECE_ROWS):
                yield _block_of(alone)
                alone = []
            if kind == "Chunk":
                stream, size = mcap.get_chunk_data_stream(record, validate_crc=True)
                block, others = _messages_in(stream.read(size))
                record.compression, record.data, record.uncompressed_crc = "", others, 0
                record.uncompressed_size = len(others)
                yield from mcap.breakup_chunk(record)
                yield block
            elif kind == "Message":
                alone.append(record)
            else:
                yield record


def _block_of(messages: Sequence[Any]) -> Block:
    """Return messages that stand in no chunk."""
    ends = np.cumsum([len(one.data) for one in messages])
    begins = np.append(0, ends[:-1])
    heads = np.column_stack([[one.channel_id for one in messages], begins, ends])
    published_ns = np.array([one.publish_time for one in messages], np.uint64)
    return Block(b"".join(one.data for one in messages), heads, published_ns)


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


@dataclass(frozen=True)
class _McapChannel:
    """What a file says of a channel, and what reads its messages, if anything does."""

    topic: str
    encoding: str
    decode: Decode | None
    ros: RosMessages | None = None


def _channel_of(record: Any, schema: Any) -> _McapChannel:
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415 - of the extra `logs`

    encoding = record.message_encoding
    if encoding == "json":
        return _McapChannel(record.topic, encoding, json.loads)
    decode: Decode | None = DecoderFactory().decoder_for(encoding, schema)
    if decode is None:
        return _McapChannel(record.topic, encoding, None)

    def decode_plain(data: bytes) -> Any:
        # The decoder reads any other as this one too, with its numbers at wrong places.
        if data[:2] not in {b"\0\0", b"\0\1"}:
            raise ValueError(f"a message is not plain CDR (it begins with {data[:2].hex()})")
        return decode(data)

    return _McapChannel(record.topic, encoding, decode_plain, RosMessages(schema, decode_plain))


_Fields = dict[str, str]
"""Paths of fields in the messages of one topic, by column."""


class McapSource(FormatSource):
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
            self._decode(wanted)
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
        encodings: dict[int, str] = {}
        for channels, block in self._blocks():
            for number in set(block.heads[:, 0].tolist()) - encodings.keys():
                channel = channels[number]
                encodings[number] = channel.encoding
                _, data, _ = next(block.of([number]).one_by_one())
                if channel.decode is not None and channel.topic not in found:
                    found[channel.topic] = list(dict(leaves_of(channel.decode(data))))
        if not found:
            raise InputError(
                f"{shown(self._file)}: no message in it can be decoded "
                f"({', '.join(sorted({*encodings.values()})) or 'none'}). Read are ROS 2 messages "
                "(cdr with ros2msg schemas) and json."
            )
        return found

    def _blocks(self) -> Iterator[tuple[dict[int, _McapChannel], Block]]:
        """Yield all messages, in the file's order, with their channels by number."""
        schemas: dict[int, Any] = {}
        channels: dict[int, _McapChannel] = {}
        for record in read_records(self._budget):
            kind = type(record).__name__
            if kind == "Block":
                yield channels, record
            elif kind == "Schema":
                schemas[record.id] = record
            elif kind == "Channel" and record.id not in channels:
                channels[record.id] = _channel_of(record, schemas.get(record.schema_id))

    def _decode(self, wanted: dict[str, _Fields]) -> None:
        """Put columns of some topics aside."""
        self._spool.clear()
        self._kept, self._numbers, self._texts = {}, set(), set()
        self._rows = dict.fromkeys(wanted, 0)
        for channels, block in self._blocks():
            for topic, fields in wanted.items():
                mine = block.of([n for n, one in channels.items() if one.topic == topic])
                if len(mine):
                    self._put_aside(topic, self._columns(fields, mine, channels))
        for topic, fields in wanted.items():
            if not self._rows[topic]:
                self._put_aside(topic, dict.fromkeys([OWN_TIME, *fields], np.zeros(0)))
        self._kept = wanted

    def _columns(
        self, fields: _Fields, block: Block, channels: dict[int, _McapChannel]
    ) -> dict[str, Any]:
        """Return the times and columns of messages of one topic."""
        numbers = np.unique(block.heads[:, 0]).tolist()
        ros = channels[numbers[0]].ros
        if len(numbers) == 1 and ros is not None:
            found = ros.read([*fields.values()], block)
            if found is not None:
                self._numbers.update(fields)
                return dict(zip([OWN_TIME, *fields], found, strict=True))
        times_s, rows = [], []
        for number, data, published_ns in block.one_by_one():
            channel = channels[number]
            if channel.decode is None:
                raise InputError(
                    f"{shown(self._file)}: topic {channel.topic!r} has a channel that nothing "
                    f"decodes ({channel.encoding!r}) beside one that is read. Record it in one "
                    "encoding, or map another topic."
                )
            message = dict(leaves_of(channel.decode(data)))
            times_s.append(stamp_s(message, published_ns))
            rows.append([message.get(path) for path in fields.values()])
        columns = zip(fields, zip(*rows, strict=True), strict=True)
        return {OWN_TIME: times_s} | {name: self._column(name, of) for name, of in columns}

    def _column(self, column: str, values: Sequence[Any]) -> pl.Series:
        """Return some values of a column: all of it are numbers, or texts."""
        some = [value for value in values if value is not None]
        if all(isinstance(value, int | float) for value in some):
            self._numbers |= {column} if some else set()
            return pl.Series(values, dtype=pl.Float64, strict=False)
        self._texts.add(column)
        return pl.Series([None if v is None else str(v) for v in values], dtype=pl.String)

    def _put_aside(self, topic: str, columns: dict[str, Any]) -> None:
        rows, content = pl.DataFrame(columns), io.BytesIO()
        rows.write_ipc_stream(content)
        self._spool.add(topic, content.getvalue())
        self._rows[topic] += len(rows)


@contextmanager
def open_mcap(budget: Budget) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    with closing(Spool()) as spool:
        yield McapSource(budget, spool)
