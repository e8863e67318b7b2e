"""Reads MCAP files: messages of ROS 2 (CDR), and of JSON. Each topic is a time base.

A column is `TOPIC.FIELD`, such as `/imu/data.linear_acceleration.y`, and `/joints.velocity[2]` of
an array. A message was taken when its header's stamp says, else when it was published. The file is
read once for what is in it, and once more for the columns that are asked for.
"""

import io
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import (
    OWN_TIME,
    Base,
    Channel,
    ClockSource,
    describe_missing,
    reading_with,
)
from fleet_slip.ingest.formats.mcap_fields import (
    AlikeMessages,
    Block,
    Decode,
    field_of,
    leaves_of,
    stamp_s,
)
from fleet_slip.ingest.formats.mcap_records import read_records
from fleet_slip.ingest.logs.spool import Spool
from fleet_slip.words import shown

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


class McapSource(ClockSource):
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
            decode = channels[number][1]
            if decode is None:
                continue
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

    def _read(self, topic: str, columns: list[str]) -> Iterator[pl.DataFrame]:
        texts = [pl.col(column).cast(pl.String) for column in columns if column in self._texts]
        for piece in self._spool.read(topic):
            yield pl.read_ipc_stream(piece).select(OWN_TIME, *columns).with_columns(texts)


@contextmanager
def open_mcap(budget: Budget) -> Iterator[McapSource]:
    """Open an MCAP file. Raises `InputError`."""
    with closing(Spool()) as spool:
        yield McapSource(budget, spool)
