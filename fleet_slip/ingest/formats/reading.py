"""Opens measured files of any format.

What a file is, its first bytes say; only what is text goes by the mapping and the name.
"""

import hashlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import polars as pl
import pyarrow as pa

from fleet_slip.base import shown
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.can import CanBus
from fleet_slip.ingest.formats.confined_source import open_confined
from fleet_slip.ingest.formats.csv import CsvFormat, PlainNumbers, open_csv
from fleet_slip.ingest.formats.source import Budget, Meter, Source
from fleet_slip.ingest.formats.tables import MAGIC as DUCKDB_MAGIC
from fleet_slip.ingest.formats.tables import MAGIC_AT as DUCKDB_AT
from fleet_slip.ingest.formats.tables import PARQUET_MAGIC, DuckdbRows, open_duckdb, open_parquet
from fleet_slip.ingest.log_files import parts_of

_HDF5, _HDF5_AT = b"\x89HDF\r\n\x1a\n", 512
"""A MATLAB file of version 7.3 becomes HDF5 there: MATLAB's own header is before it."""
_CONFINED = {
    b"MDF     ": "mdf",
    b"UnFinMF ": "mdf",
    b"\x89MCAP0\r\n": "mcap",
    b"TDSm": "tdms",
    b"MATLAB 5.0 MAT-file": "mat",
    _HDF5: "mat73",
    b"LOGG": "can_trace",
}
"""Formats that another process reads, by what a file begins with."""
_ARCHIVES = {b"PK\x03\x04": "unzip", b"7z\xbc\xaf": "7z x", b"Rar!": "unrar x"}
_BINARY = {
    (".parquet", ".pq"): "a Parquet file",
    (".mf4", ".mdf"): "an MDF file",
    (".mat", ".h5", ".hdf5"): "a MATLAB file of version 5 or 7.3",
    (".duckdb", ".ddb"): "a DuckDB file",
    (".mcap",): "an MCAP file",
    (".tdms", ".tdms_index"): "a TDMS file",
}

Told = TypeVar("Told")


@dataclass(frozen=True)
class FileFormats:
    """What must be known of a file's format beside the file.

    Attributes:
        csv: separator and decimal sign of text.
        can: the database of a CAN trace.
        duckdb: the rows of a DuckDB file.
        name: the mapping that says it, for messages.
        plain_numbers: which columns of text are numbers, wherever they are used.
    """

    csv: CsvFormat = field(default_factory=CsvFormat)
    can: CanBus | None = None
    duckdb: DuckdbRows | None = None
    name: str = "mapping suggest"
    plain_numbers: PlainNumbers = field(default_factory=PlainNumbers)


@contextmanager
def require_unchanged_log(log: Path) -> Iterator[None]:
    """Raise `InputError` if a part of a log is written to, or comes, while it is read."""
    parts = parts_of(log)
    with ExitStack() as unchanged:
        for part in parts:
            unchanged.enter_context(require_unchanged_file(part))
        yield
    if parts_of(log) != parts:
        raise InputError(
            f"{shown(log)}: files came or went while it was read. Wait until it is complete."
        )


@contextmanager
def require_unchanged_file(file: Path) -> Iterator[None]:
    """Raise `InputError` if this is no regular file, or if it is written to while it is read."""
    if not file.is_file():
        what = "is not a regular file" if file.exists() else "no such file"
        raise InputError(f"{shown(file)}: {what}. Give the path of a file.")
    with file_errors(file):
        before = file.stat()
    yield
    with file_errors(file):
        after = file.stat()
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise InputError(f"{shown(file)}: it changed while it was read. Wait until it is complete.")


def log_digest(log: Path) -> "hashlib._Hash":
    """Return the SHA-256 of a file's bytes, or of those of a log's parts. Raises `InputError`."""
    digests = []
    for part in parts_of(log):
        with file_errors(part), part.open("rb") as stream:
            digests.append(hashlib.file_digest(stream, "sha256"))
    if not log.is_dir():
        return digests[0]
    return hashlib.sha256(b"".join(digest.digest() for digest in digests))


@contextmanager
def open_source(file: Path, formats: FileFormats, meter: Meter | None = None) -> Iterator[Source]:
    """Open a file, in the format that its first bytes tell. Raises `InputError`.

    Each format makes sure that the file stands for itself: that no value of it is to be fetched
    from another file, or computed, and that it is not far more than its `Budget` once decoded.
    """
    budget = Budget.of(file, meter)
    with file.open("rb") as stream:
        start = stream.read(_HDF5_AT + len(_HDF5))
    for magic, program in _ARCHIVES.items():
        if start.startswith(magic):
            raise InputError(
                f"{shown(file)}: it is an archive. Unpack it with {program} and give the files."
            )
    with _opened(file, start, formats, budget) as source:
        yield source


def _opened(
    file: Path, start: bytes, formats: FileFormats, budget: Budget
) -> AbstractContextManager[Source]:
    suffix, name = file.suffix.lower(), _confined(start)
    if formats.can is not None:
        name = "mdf_bus" if name == "mdf" else name or "can_trace"
    elif suffix in {".blf", ".asc"}:
        name = name or "can_trace"
    if start.startswith(PARQUET_MAGIC):
        return open_parquet(budget)
    if start[DUCKDB_AT:].startswith(DUCKDB_MAGIC):
        rows = _wanted(formats.duckdb, file, "duckdb", 'table = "…"', formats)
        return open_duckdb(rows, budget)
    if name == "can_trace":
        _wanted(formats.can, file, "can", 'database = "….dbc"', formats)
    if name:
        bus = formats.can if name in {"can_trace", "mdf_bus"} else None
        return open_confined(name, bus, budget)
    for suffixes, kind in _BINARY.items():
        if suffix in suffixes:
            raise InputError(
                f"{shown(file)}: not {kind}, whatever its name says. Export it again, or name it "
                "as what it is."
            )
    return open_csv(budget, formats.csv, formats.plain_numbers)


def _confined(start: bytes) -> str:
    """Return the format that another process reads, empty for any other."""
    begun = start[_HDF5_AT:] if start.endswith(_HDF5) else start
    return next((name for magic, name in _CONFINED.items() if begun.startswith(magic)), "")


def _wanted(told: Told | None, file: Path, table: str, key: str, formats: FileFormats) -> Told:
    """Return what the mapping says of a format that needs it. Raises `InputError`."""
    if told is None:
        raise InputError(
            f"{shown(file)}: this format needs [{table}] with {key} in the mapping "
            f"{formats.name!r}."
        )
    return told


@contextmanager
def file_errors(file: Path) -> Iterator[None]:
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
