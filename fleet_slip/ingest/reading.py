"""Reads CSV and Parquet files from strangers in bounded batches, and names what is wrong with them.

A batch is a Polars frame with the columns that were asked for: text (CSV, text in Parquet), 64-bit
floats, dates or timestamps. CSV fields stay text, so that what is not a number can be quarantined
as it was written.
"""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

import polars as pl
import pyarrow as pa

from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import shown
from fleet_slip.ingest.csv_batches import BLOCK_BYTES, csv_batches
from fleet_slip.ingest.mapping import CsvFormat
from fleet_slip.ingest.parquet_batches import PARQUET_MAGIC, parquet_batches

COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""What compressed files begin with."""

MAX_ROWS = 20_000_000
"""Rows of one file: 55 hours at 100 Hz. All of them are in memory once, as float64."""


@contextmanager
def require_unchanged_file(file: Path) -> Iterator[None]:
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
        binary = stream.read(len(PARQUET_MAGIC)) == PARQUET_MAGIC
        stream.seek(0)
        if not binary and file.suffix.lower() in {".parquet", ".pq"}:
            raise InputError(
                f"{shown(file)}: not a Parquet file. Export it again, or name it .csv."
            )
        batches = (
            parquet_batches(stream, file, columns, MAX_ROWS)
            if binary
            else csv_batches(_decompressed(stream), file, columns, csv_format)
        )
        for batch in batches:
            rows += batch.height
            if rows > MAX_ROWS:
                raise InputError(f"{shown(file)}: more than {MAX_ROWS:,} rows. Split the file.")
            yield batch


def _decompressed(stream: BinaryIO) -> BinaryIO:
    """Return the text of a stream, whatever it is compressed with."""
    start = stream.read(max(map(len, COMPRESSED)))
    stream.seek(0)
    for magic, codec in COMPRESSED.items():
        if start.startswith(magic):
            # Text is read in blocks: what a small file may become is never in memory at once.
            plain = pa.CompressedInputStream(stream, codec)
            return BufferedReader(plain, BLOCK_BYTES)
    return stream


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
