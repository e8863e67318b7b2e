"""Reads Parquet: text, numbers, dates and timestamps."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.source import Budget, Channel, Source, find_column

MAGIC = b"PAR1"
BATCH_ROWS = 2**16
"""Parquet is read in batches of this many rows."""

BUFFER_BYTES = 2**16
"""Bytes of a column that are read at once."""
MAX_FOOTER_BYTES = 2**24
"""Size of a footer: parsing a larger one would take too much memory."""
MAX_TEXT = 1_000
"""Characters of one text in Parquet: a dictionary can repeat a long one for the price of a bit."""

_PER_DAY = {"d": 1, "ms": 86_400 * 10**3, "us": 86_400 * 10**6, "ns": 86_400 * 10**9}
_FIRST_DAY = date.min.toordinal() - date(1970, 1, 1).toordinal()
_LAST_DAY = date.max.toordinal() - date(1970, 1, 1).toordinal()


class ParquetSource(Source):
    """An open Parquet file. Keys in the names of its folders, `car=A7`, are columns of text.

    The null partition of Hive is a missing value.
    """

    def __init__(self, stream: pa.NativeFile, budget: Budget) -> None:
        """Take the bytes of a file, and its limits."""
        self._file, self._stream = budget.file, stream
        _require_footer(stream, budget)
        parquet = pq.ParquetFile(stream)
        # Not its columns: for some damaged footers pyarrow aborts the process that asks for one.
        metadata = parquet.metadata
        groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
        budget.require_rows(sum(abs(group.num_rows) for group in groups))
        budget.require_unfolded(sum(abs(group.total_byte_size) for group in groups))
        self._schema = parquet.schema_arrow
        keys = partition_keys(budget.file).items()
        self._keys = {name: text for name, text in keys if name not in self._schema.names}

    def channels(self) -> list[Channel]:
        """Return the columns."""
        readable = [f.name for f in self._schema if is_readable(f.type)]
        return [Channel(name) for name in (*readable, *self._keys)]

    def find(self, column: str) -> tuple[str, pl.Expr | None]:
        """Return the text of a folder's key as a literal, or None. Raises `InputError`."""
        find_column(self._file, [*self._schema.names, *self._keys], column)
        if column in self._keys:
            return "", pl.lit(self._keys[column], pl.String).alias(column)
        kind = self._schema.field(column).type
        if not is_readable(kind):  # before anything is decoded: one list can be all of a file
            raise InputError(
                f"{quote_name(self._file)}: column {column!r} has the type "
                f"{quote_name(kind)[:80]}, which is "
                "neither a number, text nor a time. Convert it or map another one."
            )
        return "", None

    def read(self, _base: str, texts_of_folders: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield rows. Raises `InputError`."""
        inside = [name for name, text in texts_of_folders.items() if text is None]
        keys = [text for text in texts_of_folders.values() if text is not None]
        texts = [name for name in inside if _is_text(self._schema.field(name).type)]
        # Buffered before, the bytes of the whole file would stay in memory until its end; and
        # without a buffer those of each column of a row group, of which a file may have only one.
        parquet = pq.ParquetFile(
            self._stream,
            read_dictionary=texts,
            page_checksum_verification=True,
            pre_buffer=False,
            buffer_size=BUFFER_BYTES,
        )
        for batch in parquet.iter_batches(BATCH_ROWS, columns=inside):
            plain = {name: plain_column(batch.column(name), name, self._file) for name in inside}
            yield _in_calendar(pl.DataFrame(pa.table(plain))).with_columns(keys)


@contextmanager
def open_parquet(budget: Budget) -> Iterator[ParquetSource]:
    """Open a Parquet file. Raises `InputError`."""
    # Not Python's own file: each read of Arrow's threads would wait for the interpreter.
    with pa.OSFile(os.fsencode(budget.file), "rb") as stream:
        yield ParquetSource(stream, budget)


NULL_PARTITION = "__HIVE_DEFAULT_PARTITION__"
"""The text of a folder's key for rows without a value, as Hive, Spark and Polars write it."""


def partition_keys(file: Path) -> dict[str, str | None]:
    """Return the keys of the folders above a file, `key=value`; None for a null partition."""
    named = (part.partition("=") for part in file.parts[:-1])
    keys = {key: unquote(text) for key, equals, text in named if key and equals}
    return {key: None if text == NULL_PARTITION else text for key, text in keys.items()}


def _require_footer(stream: pa.NativeFile, budget: Budget) -> None:
    """Raise `InputError` for a footer whose parsing would take too much memory."""
    tail = stream.read_at(8, max(0, stream.size() - 8))
    if tail[4:] == MAGIC and int.from_bytes(tail[:4], "little") > MAX_FOOTER_BYTES:
        raise budget.exceeded(f"its footer has more than {MAX_FOOTER_BYTES:,} bytes")


def is_readable(kind: pa.DataType) -> bool:
    """Return True if a column of this type is text, a number or a time."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    tests = (_is_text, pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
    times = (pa.types.is_date, pa.types.is_timestamp, pa.types.is_null)
    return any(is_it(kind) for is_it in (*tests, *times))


def _is_text(kind: pa.DataType) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def plain_column(array: pa.Array, name: str, file: Path) -> pa.Array:
    """Return a readable column as text, float64, date or timestamp. Raises `InputError`.

    Integers of 64 bits, and decimals as text, keep all digits: they may be identifiers.
    """
    array.validate(full=True)  # text of Parquet may be invalid UTF-8, which Polars does not check
    if pa.types.is_dictionary(array.type):
        longest = pc.max(pc.utf8_length(array.dictionary)).as_py() if _is_text(array.type) else 0
        if longest is not None and longest > MAX_TEXT:
            raise InputError(
                f"{quote_name(file)}: column {name!r} has texts of {longest:,} characters, "
                f"at most {MAX_TEXT:,} are read."
            )
        array = array.dictionary_decode()
    kind = array.type
    is_time = pa.types.is_date(kind) or pa.types.is_timestamp(kind)
    if _is_text(kind) or is_time or kind in {pa.int64(), pa.uint64()}:
        return array
    return pc.cast(array, pa.string() if pa.types.is_decimal(kind) else pa.float64(), safe=False)


def _in_calendar(frame: pl.DataFrame) -> pl.DataFrame:
    """Return dates and timestamps as null outside the years 1 to 9999: Polars would panic."""
    inside = []
    for name, kind in frame.schema.items():
        if kind.is_temporal():
            days = pl.col(name).to_physical() // _PER_DAY[getattr(kind, "time_unit", "d")]
            inside.append(pl.when(days.is_between(_FIRST_DAY, _LAST_DAY)).then(name))
    return frame.with_columns(inside)
