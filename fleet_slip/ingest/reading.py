"""Reads CSV and Parquet files from strangers in bounded batches, and names what is wrong with them.

A batch is a Polars frame with the columns that were asked for: text (CSV, text in Parquet), 64-bit
floats, dates or timestamps. CSV fields stay text, so that what is not a number can be quarantined
as it was written.
"""

import csv
import difflib
import hashlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import date
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.errors import InputError
from fleet_slip.ingest.mapping import CsvFormat

BLOCK_BYTES = 2**24
"""CSV is parsed in blocks of about this size."""
BATCH_ROWS = 2**17
"""Parquet is read in batches of this many rows."""
MAX_ROWS = 20_000_000
"""Rows of one file: 55 hours at 100 Hz. All of them are in memory once, as float64."""
MAX_COLUMNS = 10_000
MAX_LINE_BYTES = 2**20
MAX_FOOTER_BYTES = 2**24
MAX_TEXT = 1_000
"""Characters of one text in Parquet: a dictionary can repeat a long one for the price of a bit."""
EXTRA_FIELDS = "\0extra fields"
"""Column of a CSV batch: what a line has after the header's last column, null if nothing."""

_PARQUET_MAGIC = b"PAR1"
_PER_DAY = {unit: 86_400 * 10**power for unit, power in {"s": 0, "ms": 3, "us": 6, "ns": 9}.items()}
_FIRST_DAY = date.min.toordinal() - date(1970, 1, 1).toordinal()
_END_DAY = date.max.toordinal() + 1 - date(1970, 1, 1).toordinal()
_SHOWN_COLUMNS = 30


def shown(text: object) -> str:
    """Return a name as it can stand in a one-line message, whatever characters it has."""
    plain = str(text)
    return plain if plain.isprintable() else repr(plain)


@contextmanager
def unchanged(file: Path) -> Iterator[None]:
    """Raise `InputError` if this is no regular file, or if it is written to while it is read."""
    if not file.is_file():
        what = "is not a regular file" if file.exists() else "no such file"
        raise InputError(f"{shown(file)}: {what}. Give the path of a CSV or Parquet file.")
    with _file_errors(file):
        before = file.stat()
    yield
    with _file_errors(file):
        after = file.stat()
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise InputError(f"{shown(file)}: it changed while it was read. Wait until it is complete.")


def file_digest(file: Path) -> "hashlib._Hash":
    """Return the SHA-256 of a file's bytes, open for more. Raises `InputError`."""
    with _file_errors(file), file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256")


def read_batches(
    file: Path, columns: Sequence[str], csv_format: CsvFormat
) -> Iterator[pl.DataFrame]:
    """Yield the named columns of a CSV or Parquet file, in the file's order, in bounded batches.

    Raises `InputError` if the file cannot be read, a column is missing or ambiguous, or the file
    is larger than the limits of this module.
    """
    rows = 0
    with _file_errors(file), file.open("rb") as stream:
        binary = stream.read(len(_PARQUET_MAGIC)) == _PARQUET_MAGIC
        stream.seek(0)
        if not binary and file.suffix.lower() in {".parquet", ".pq"}:
            raise InputError(
                f"{shown(file)}: not a Parquet file. Export it again, or name it .csv."
            )
        read = _parquet_batches if binary else _csv_batches
        for batch in read(stream, file, columns, csv_format):
            rows += batch.height
            if rows > MAX_ROWS:
                raise InputError(f"{shown(file)}: more than {MAX_ROWS:,} rows. Split the file.")
            yield batch


@contextmanager
def _file_errors(file: Path) -> Iterator[None]:
    """Turn what the operating system, Polars and pyarrow raise into an `InputError`."""
    try:
        yield
    except (
        OSError,
        ValueError,
        MemoryError,
        pa.ArrowException,
        pl.exceptions.PolarsError,
        pl.exceptions.PanicException,
    ) as error:
        reason = shown(str(error).strip().split("\n")[0][:200]) or type(error).__name__
        raise InputError(
            f"{shown(file)}: cannot be read: {reason}. Is it complete? Copy or export it again."
        ) from None


def _positions(file: Path, names: Sequence[str], wanted: Iterable[str]) -> dict[str, int]:
    """Return where each wanted column stands. Raises `InputError` for none or two of a name."""
    if len(names) > MAX_COLUMNS:
        raise InputError(
            f"{shown(file)}: {len(names):,} columns, at most {MAX_COLUMNS:,} are read."
        )
    positions: dict[str, int] = {}
    for column in wanted:
        found = [i for i, name in enumerate(names) if name == column]
        if len(found) > 1:
            where = ", ".join(str(i + 1) for i in found[:5])
            raise InputError(
                f"{shown(file)}: {len(found)} columns are called {column!r} (number {where}). "
                "Rename all but one."
            )
        if not found:
            raise InputError(f"{shown(file)}: {_missing_column(column, names)}")
        positions[column] = found[0]
    return positions


def _missing_column(column: str, names: Sequence[str]) -> str:
    folded = {name.casefold(): name for name in names}
    matches = difflib.get_close_matches(column.casefold(), folded, n=3, cutoff=0.6)
    near = [folded[match] for match in matches]
    hint = f" Did the mapping mean {' or '.join(repr(name[:80]) for name in near)}?" if near else ""
    there = ", ".join(repr(name[:80]) for name in names[:_SHOWN_COLUMNS])
    more = f" and {len(names) - _SHOWN_COLUMNS:,} more" if len(names) > _SHOWN_COLUMNS else ""
    return f"no column {column!r}.{hint} Its columns are {there}{more}."


# CSV


def _csv_batches(
    stream: BinaryIO, file: Path, columns: Sequence[str], csv_format: CsvFormat
) -> Iterator[pl.DataFrame]:
    names = _csv_header(stream, file, csv_format)
    positions = _positions(file, names, columns)
    # Columns are read by position: Polars renames duplicates. The line of separators before each
    # block fixes the number of fields and keeps a block from looking like a compressed file.
    fields = [f"column {i}" for i in range(len(names))] + [EXTRA_FIELDS]
    padding = csv_format.separator.encode() * len(names) + b"\n"
    selection = [pl.col(fields[i]).alias(name) for name, i in positions.items()]
    for block in _whole_lines(stream, file):
        frame = pl.scan_csv(
            BytesIO(padding + block),
            has_header=False,
            separator=csv_format.separator,
            schema=dict.fromkeys(fields, pl.String),
            truncate_ragged_lines=True,
        )
        yield frame.select(*selection, EXTRA_FIELDS).collect().slice(1)


def _csv_header(stream: BinaryIO, file: Path, csv_format: CsvFormat) -> list[str]:
    line = stream.readline(MAX_LINE_BYTES + 1)
    if not line.strip():
        raise InputError(
            f"{shown(file)}: {'its first line is' if line else 'it is'} empty. Export it again."
        )
    if len(line) > MAX_LINE_BYTES:
        raise InputError(
            f"{shown(file)}: the header is longer than {MAX_LINE_BYTES:,} bytes. Is it a CSV file?"
        )
    text = _decode(line.removeprefix(b"\xef\xbb\xbf"), file).rstrip("\r\n")
    try:
        names = next(csv.reader([text], delimiter=csv_format.separator, strict=True))
    except csv.Error as error:
        raise InputError(f"{shown(file)}: its header is not CSV: {error}.") from None
    return [name.strip() for name in names]


def _whole_lines(stream: BinaryIO, file: Path) -> Iterator[bytes]:
    """Yield blocks of UTF-8 that end with a line; a line break in quotes does not end one."""
    rest = b""
    while block := stream.read(BLOCK_BYTES):
        block = rest + block
        end = _end_of_lines(block)
        if not end and len(block) > 2 * BLOCK_BYTES:
            raise InputError(
                f"{shown(file)}: a line is longer than {BLOCK_BYTES:,} bytes. "
                "Is a quote not closed?"
            )
        if end:
            _decode(block[:end], file)
            yield block[:end]
        rest = block[end:]
    if rest:
        _decode(rest, file)
        yield rest


def _end_of_lines(block: bytes) -> int:
    """Return where the last whole line ends: behind a line break with no open quote before it."""
    end = block.rfind(b"\n") + 1
    if block.count(b'"', 0, end) % 2 == 0:
        return end
    characters = np.frombuffer(block[:end], dtype=np.uint8)
    open_quote = np.logical_xor.accumulate(characters == ord('"'))
    ends = np.flatnonzero((characters == ord("\n")) & ~open_quote)
    return int(ends[-1]) + 1 if ends.size else 0


def _decode(block: bytes, file: Path) -> str:
    advice = "Save it as UTF-8 text, or give a Parquet file."
    if b"\0" in block:
        raise InputError(f"{shown(file)}: binary or UTF-16, not a UTF-8 CSV file. {advice}")
    try:
        return block.decode("utf-8")
    except UnicodeDecodeError as error:
        line = block[error.start - min(error.start, 20) : error.start + 20]
        raise InputError(f"{shown(file)}: not UTF-8, near {line!r}. {advice}") from None


# Parquet


def _parquet_batches(
    stream: BinaryIO, file: Path, columns: Sequence[str], _: CsvFormat
) -> Iterator[pl.DataFrame]:
    _check_footer_size(stream, file)
    schema = pq.ParquetFile(stream).schema_arrow
    _positions(file, schema.names, columns)
    texts = [name for name in columns if _is_text(schema.field(name).type)]
    parquet = pq.ParquetFile(stream, read_dictionary=texts, page_checksum_verification=True)
    if parquet.metadata.num_rows > MAX_ROWS:
        raise InputError(
            f"{shown(file)}: {parquet.metadata.num_rows:,} rows, at most {MAX_ROWS:,} are read. "
            "Split the file."
        )
    for batch in parquet.iter_batches(BATCH_ROWS, columns=list(columns)):
        plain = {name: _plain(batch.column(name), name, file) for name in columns}
        yield pl.DataFrame(pa.table(plain))


def _check_footer_size(stream: BinaryIO, file: Path) -> None:
    size = stream.seek(0, 2)
    stream.seek(max(0, size - 8))
    tail = stream.read(8)
    stream.seek(0)
    if tail[4:] != _PARQUET_MAGIC or size < 12:
        raise InputError(
            f"{shown(file)}: begins as a Parquet file but has no footer: it is truncated. "
            "Copy it again."
        )
    if int.from_bytes(tail[:4], "little") > MAX_FOOTER_BYTES:
        raise InputError(
            f"{shown(file)}: its footer is too large. Write fewer columns or row groups."
        )


def _is_text(arrow_type: pa.DataType) -> bool:
    if pa.types.is_dictionary(arrow_type):
        arrow_type = arrow_type.value_type
    return bool(pa.types.is_string(arrow_type) or pa.types.is_large_string(arrow_type))


def _plain(array: pa.Array, name: str, file: Path) -> pa.Array:
    """Return a column as text, float64, date or timestamp. Raises `InputError` for others."""
    array.validate(full=True)  # what Parquet calls text need not be UTF-8, and Polars trusts it
    if pa.types.is_dictionary(array.type):
        longest = pc.max(pc.utf8_length(array.dictionary)).as_py() if _is_text(array.type) else 0
        if longest is not None and longest > MAX_TEXT:
            raise InputError(
                f"{shown(file)}: column {name!r} has texts of {longest:,} characters, "
                f"at most {MAX_TEXT:,} are read."
            )
        array = array.dictionary_decode()
    kind = array.type
    if _is_text(kind):
        return array
    if pa.types.is_date(kind) or pa.types.is_timestamp(kind):
        return _in_calendar(array)
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        return pc.cast(array, pa.float64(), safe=False)
    if pa.types.is_null(kind):
        return pc.cast(array, pa.float64())
    raise InputError(
        f"{shown(file)}: column {name!r} has the type {shown(kind)[:80]}, which is neither a "
        "number, text nor a time. Convert it or map another one."
    )


def _in_calendar(array: pa.Array) -> pa.Array:
    """Return dates or timestamps with null for those outside the years 1 to 9999.

    They are no times of a drive, and Polars panics when it should show one.
    """
    kind = array.type
    if pa.types.is_date32(kind):
        counts, per_day = pc.cast(pc.cast(array, pa.int32()), pa.int64()), 1
    else:
        unit = "ms" if pa.types.is_date64(kind) else kind.unit
        counts, per_day = pc.cast(array, pa.int64()), _PER_DAY[unit]
    first, end = (max(-(2**63), min(2**63 - 1, days * per_day)) for days in (_FIRST_DAY, _END_DAY))
    inside = pc.and_(pc.greater_equal(counts, first), pc.less(counts, end))
    return pc.if_else(inside, array, pa.scalar(None, kind))
