"""Reads MCAP files: messages of ROS 2 (CDR), and of JSON. Each topic is a time base.

A column is `TOPIC.FIELD`, such as `/imu/data.linear_acceleration.y`, and `/joints.velocity[2]` of
an array. The time of a message is its header's stamp, else the time of publication. The file is
read once for its topics, and once more for each topic with columns of a mapping.
"""

import json
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import islice
from typing import Any

import polars as pl

from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import (
    OWN_TIME,
    Budget,
    Channel,
    Source,
    load_library,
    missing_column,
)

Decode = Callable[[bytes], Any]
_MAX_ITEMS, _DEEPEST = 64, 20
"""Items of an array that are columns, and levels of messages in messages."""
PIECE_ROWS = 2**13
"""Messages of a topic that are in memory at once."""


def leaves_of(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, float | str]]:
    """Yield the numbers and texts in a message, with their paths."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, bool | int | float):
        yield path, float(value)
    elif depth < _DEEPEST:
        if isinstance(value, list | tuple | array):
            below = {f"{path}[{number}]": item for number, item in enumerate(value[:_MAX_ITEMS])}
        else:
            names = value if isinstance(value, dict) else getattr(type(value), "__slots__", ())
            members = value if isinstance(value, dict) else {n: getattr(value, n) for n in names}
            below = {f"{path}.{name}" if path else name: item for name, item in members.items()}
        for name, item in below.items():
            yield from leaves_of(item, name, depth + 1)


def stamp_s(fields: dict[str, float | str], published_ns: int) -> float:
    """Return the time of a message in s: its header's stamp, else the time of publication."""
    for stamp in ("header.stamp", "stamp"):
        seconds, nanoseconds = fields.get(f"{stamp}.sec"), fields.get(f"{stamp}.nanosec")
        if isinstance(seconds, float) and isinstance(nanoseconds, float) and seconds + nanoseconds:
            return seconds + nanoseconds * 1e-9
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
        # The decoder would read other encodings as this one, with wrong numbers.
        if data[:2] not in {b"\0\0", b"\0\1"}:
            raise ValueError(f"a message is not plain CDR (it begins with {data[:2].hex()})")
        return decode(data)

    return decode_plain


class McapSource(Source):
    """The topics of an MCAP file."""

    has_clock = True

    def __init__(self, budget: Budget) -> None:
        """Take the file."""
        self._budget = budget

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
            raise self._missing(column)
        topic = max(topics, key=len)
        return topic, column[len(topic) + 1 :]

    def _missing(self, column: str) -> Exception:
        return missing_column(self._budget.file, column, [c.name for c in self.channels()])

    def read(self, topic: str, fields: dict[str, str]) -> Iterator[pl.DataFrame]:
        """Yield fields of a topic, texts or numbers. Raises `InputError` for a field without any.

        A field whose first messages have no value is one of numbers.
        """
        rows = self._rows(topic, [*fields.values()])
        texts: dict[str, bool] = {}
        absent = set(fields)
        while piece := list(islice(rows, PIECE_ROWS)):
            frame = pl.DataFrame({OWN_TIME: [row[0] for row in piece]})
            for place, column in enumerate(fields, 1):
                values = [row[place] for row in piece]
                types = {isinstance(value, str) for value in values if value is not None}
                is_text = texts.setdefault(column, types == {True})
                if types - {is_text}:
                    raise self._budget.error(
                        f"{column!r} has texts in some messages and numbers in others. Map another "
                        "field."
                    )
                absent -= {column} if types else set()
                kind = pl.String if is_text else pl.Float64
                frame = frame.with_columns(pl.Series(column, values, dtype=kind))
            yield frame
        for column in absent:
            raise self._missing(column)

    def _rows(self, topic: str, fields: Sequence[str]) -> Iterator[list[Any]]:
        """Yield the time in s and the values of fields of each message of a topic."""
        for channel, decode, message in self._messages():
            if channel.topic == topic:
                if decode is None:
                    raise self._budget.error(
                        f"topic {topic!r} has messages in an encoding that is not supported "
                        f"({channel.message_encoding!r}). Map another topic."
                    )
                leaves = dict(leaves_of(decode(message.data)))
                yield [stamp_s(leaves, message.publish_time), *map(leaves.get, fields)]

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
            raise self._budget.error(
                f"no message in it can be decoded ({', '.join(sorted(encodings)) or 'none'}). "
                "Supported are ROS 2 messages (cdr with ros2msg schemas) and json."
            )
        return fields_by_topic

    def _messages(self) -> Iterator[tuple[Any, Decode | None, Any]]:
        """Yield the channel, the decoder and the record of all messages, in the file's order."""
        mcap = load_library(self._budget.file, "mcap.stream_reader")
        schemas: dict[int, Any] = {}
        channels: dict[int, tuple[Any, Decode | None]] = {}
        with self._budget.file.open("rb") as file:
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


@contextmanager
def open_mcap(budget: Budget, _formats: FileFormats) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    yield McapSource(budget)
