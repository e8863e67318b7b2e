"""Reads MCAP files: messages of ROS 2 (CDR), and of JSON. Each topic is a time base.

A column is `TOPIC.FIELD`, such as `/imu/data.linear_acceleration.y`, and `/joints.velocity[2]` of
an array. The time of a message is its header's stamp, else the time of publication. The file is
read once for its topics, and once more for the columns of a mapping.
"""

import io
import json
import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import polars as pl

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.file_formats import FileFormats
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
_MAX_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""
PIECE_ROWS = 2**13
"""Messages of a topic that are in memory at once."""


def leaves_of(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the numbers and texts in a message, with their paths."""
    if isinstance(value, bool | int | float | str):
        yield path, value
    elif depth < _DEEPEST:
        below: list[tuple[str, Any]]
        if isinstance(value, list | tuple | array):
            below = [(f"[{number}]", item) for number, item in enumerate(value[:_MAX_ITEMS])]
        else:
            names = value if isinstance(value, dict) else getattr(type(value), "__slots__", ())
            members = value if isinstance(value, dict) else {n: getattr(value, n) for n in names}
            below = [(f".{name}" if path else str(name), members[name]) for name in names]
        for name, item in below:
            yield from leaves_of(item, path + name, depth + 1)


_Path = tuple[str | int, ...]
_STAMPS: tuple[tuple[_Path, _Path], ...] = tuple(
    ((*above, "stamp", "sec"), (*above, "stamp", "nanosec")) for above in (("header",), ())
)


def parse_path(name: str) -> _Path:
    """Return the names and numbers that lead to a field."""
    steps = re.findall(r"\[(\d+)\]|\.?([^.\[]+)", name)
    return tuple(int(number) if number else name for number, name in steps)


def value_at(message: Any, path: _Path) -> Any:
    """Return the number or text of a field, None where there is none."""
    for step in path:
        if isinstance(step, str):
            message = (
                message.get(step) if isinstance(message, dict) else getattr(message, step, None)
            )
        elif isinstance(message, list | tuple | array) and step < min(len(message), _MAX_ITEMS):
            message = message[step]
        else:
            return None
    return message if isinstance(message, bool | int | float | str) else None


def stamp_s(message: Any, published_ns: int) -> float:
    """Return the time of a message in s: its header's stamp, else the time of publication."""
    for paths in _STAMPS:
        seconds, nanoseconds = (value_at(message, path) for path in paths)
        if isinstance(seconds, int) and isinstance(nanoseconds, int) and (seconds or nanoseconds):
            return float(seconds) + float(nanoseconds) * 1e-9
    return published_ns * 1e-9


def _decoder_of(channel: Any, schema: Any) -> Decode | None:
    """Return the decoder of a channel's messages, None if there is none."""
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


class McapSource(FormatSource):
    """The topics of an MCAP file."""

    def __init__(self, budget: Budget) -> None:
        """Take the file."""
        self._file, self._spool = budget.file, Spool()
        self._decoded: dict[str, _Fields] = {}
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
            raise missing_column(self._file, column, [channel.name for channel in self.channels()])
        topic = max(topics, key=len)
        return topic, column[len(topic) + 1 :]

    def prepare(self, places_by_base: dict[str, _Fields]) -> None:
        """Decode columns and put them aside, unless they are. Raises `InputError`."""
        if any(
            not fields.keys() <= self._decoded.get(topic, {}).keys()
            for topic, fields in places_by_base.items()
        ):
            self._decode(places_by_base)
        for topic, fields in places_by_base.items():
            for column in fields.keys() - self._numbers - self._texts:
                names = [f"{topic}.{name}" for name in self._topics[topic]]
                raise missing_column(self._file, column, names)

    def read(self, topic: str, places: _Fields) -> Iterator[pl.DataFrame]:
        """Yield fields of a topic."""
        texts = [pl.col(column).cast(pl.String) for column in places if column in self._texts]
        for piece in self._spool.read(topic):
            yield pl.read_ipc_stream(piece).select(OWN_TIME, *places).with_columns(texts)

    @cached_property
    def _topics(self) -> dict[str, list[str]]:
        """The fields of the first message of each topic that can be decoded."""
        fields_by_topic: dict[str, list[str]] = {}
        encodings = set[str]()
        for channel, decode, message in self._messages():
            encodings.add(channel.message_encoding)
            if decode is not None and channel.topic not in fields_by_topic:
                fields_by_topic[channel.topic] = list(dict(leaves_of(decode(message.data))))
        if not fields_by_topic:
            raise InputError(
                f"{quote_name(self._file)}: no message in it can be decoded "
                f"({', '.join(sorted(encodings)) or 'none'}). Supported are ROS 2 messages "
                "(cdr with ros2msg schemas) and json."
            )
        return fields_by_topic

    def _messages(self) -> Iterator[tuple[Any, Decode | None, Any]]:
        """Yield the channel, the decoder and the record of all messages, in the file's order."""
        mcap = load_library(self._file, "mcap.stream_reader")
        schemas: dict[int, Any] = {}
        channels: dict[int, tuple[Any, Decode | None]] = {}
        with self._file.open("rb") as file:
            reader = mcap.StreamReader(file, validate_crcs=True, record_size_limit=None)
            for record in reader.records:
                kind = type(record).__name__
                if kind == "Message":
                    yield *channels[record.channel_id], record
                elif kind == "Schema":
                    schemas[record.id] = record
                elif kind == "Channel" and record.id not in channels:
                    decode = _decoder_of(record, schemas.get(record.schema_id))
                    channels[record.id] = record, decode

    def _decode(self, fields_by_topic: dict[str, _Fields]) -> None:
        """Put columns of some topics aside."""
        self._spool.clear()
        self._decoded, self._numbers, self._texts = {}, set(), set()
        waiting: dict[str, list[list[Any]]] = {topic: [] for topic in fields_by_topic}
        paths = {
            topic: [parse_path(name) for name in fields.values()]
            for topic, fields in fields_by_topic.items()
        }
        for channel, decode, message in self._messages():
            topic = channel.topic
            if topic not in fields_by_topic:
                continue
            if decode is None:
                raise InputError(
                    f"{quote_name(self._file)}: topic {topic!r} has messages in an encoding that "
                    "is "
                    f"not supported ({channel.message_encoding!r}). Record it in one encoding, or "
                    "map another topic."
                )
            content = decode(message.data)
            values = [value_at(content, path) for path in paths[topic]]
            waiting[topic].append([stamp_s(content, message.publish_time), *values])
            if len(waiting[topic]) >= PIECE_ROWS:
                self._put_aside(topic, fields_by_topic[topic], waiting[topic])
                waiting[topic] = []
        for topic, rows in waiting.items():
            self._put_aside(topic, fields_by_topic[topic], rows)
        self._decoded = fields_by_topic

    def _put_aside(self, topic: str, fields: _Fields, rows: list[list[Any]]) -> None:
        times_s, *values = zip(*rows, strict=True) if rows else [()] * (1 + len(fields))
        columns = [pl.Series(OWN_TIME, times_s, dtype=pl.Float64)]
        columns += [self._column(*pair) for pair in zip(fields, values, strict=True)]
        content = io.BytesIO()
        pl.DataFrame(columns).write_ipc_stream(content)
        self._spool.add(topic, content.getvalue())

    def _column(self, column: str, values: Sequence[Any]) -> pl.Series:
        """Return some values of a column: all of it are numbers, or texts."""
        present = [value for value in values if value is not None]
        if all(isinstance(value, int | float) for value in present):
            self._numbers |= {column} if present else set()
            return pl.Series(column, values, dtype=pl.Float64, strict=False)
        self._texts.add(column)
        return pl.Series(column, [v if v is None else str(v) for v in values], dtype=pl.String)


@contextmanager
def open_mcap(budget: Budget, _formats: FileFormats) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    yield McapSource(budget)
