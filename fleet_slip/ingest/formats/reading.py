"""Opens measured files of any format.

What a file is, its first bytes say; only what is text goes by the mapping and the name.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import polars as pl
import pyarrow as pa

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.can.blf_frames import MAGIC as BLF_MAGIC
from fleet_slip.ingest.formats.can.can_bus import CanBus
from fleet_slip.ingest.formats.can.can_trace import open_can_trace
from fleet_slip.ingest.formats.csv_batches import PlainNumbers, open_csv
from fleet_slip.ingest.formats.csv_text import CsvFormat
from fleet_slip.ingest.formats.duckdb_table import MAGIC as DUCKDB_MAGIC
from fleet_slip.ingest.formats.duckdb_table import MAGIC_AT as DUCKDB_AT
from fleet_slip.ingest.formats.duckdb_table import DuckdbRows, open_duckdb
from fleet_slip.ingest.formats.log_source import Source
from fleet_slip.ingest.formats.matlab import HDF5_AT, HDF5_MAGIC, MAT5_MAGIC, open_mat, open_mat73
from fleet_slip.ingest.formats.mcap_log import open_mcap
from fleet_slip.ingest.formats.mcap_records import MAGIC as MCAP_MAGIC
from fleet_slip.ingest.formats.mdf import MAGICS as MDF_MAGICS
from fleet_slip.ingest.formats.mdf import open_mdf
from fleet_slip.ingest.formats.mdf_bus import open_mdf_bus
from fleet_slip.ingest.formats.meter import Meter
from fleet_slip.ingest.formats.parquet_batches import PARQUET_MAGIC, open_parquet
from fleet_slip.ingest.formats.tdms import MAGIC as TDMS_MAGIC
from fleet_slip.ingest.formats.tdms import open_tdms
from fleet_slip.ingest.logs.log_files import parts_of
from fleet_slip.words import shown

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
        start = stream.read(HDF5_AT + len(HDF5_MAGIC))
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
    if start.startswith(MDF_MAGICS) and formats.can is not None:
        return open_mdf_bus(formats.can, budget)
    for is_it, open_it in _FORMATS:
        if is_it(start):
            return open_it(budget)
    if start[DUCKDB_AT:].startswith(DUCKDB_MAGIC):
        rows = _wanted(formats.duckdb, file, "duckdb", 'table = "…"', formats)
        return open_duckdb(rows, budget)
    suffix = file.suffix.lower()
    if formats.can is not None or start.startswith(BLF_MAGIC) or suffix in {".blf", ".asc"}:
        bus = _wanted(formats.can, file, "can", 'database = "….dbc"', formats)
        return open_can_trace(bus, budget)
    for suffixes, kind in _BINARY.items():
        if suffix in suffixes:
            raise InputError(
                f"{shown(file)}: not {kind}, whatever its name says. Export it again, or name it "
                "as what it is."
            )
    return open_csv(budget, formats.csv, formats.plain_numbers)


def _wanted(told: Told | None, file: Path, table: str, key: str, formats: FileFormats) -> Told:
    """Return what the mapping says of a format that needs it. Raises `InputError`."""
    if told is None:
        raise InputError(
            f"{shown(file)}: this format needs [{table}] with {key} in the mapping "
            f"{formats.name!r}."
        )
    return told


_FORMATS: tuple[
    tuple[Callable[[bytes], bool], Callable[[Budget], AbstractContextManager[Source]]], ...
] = (
    (lambda start: start.startswith(PARQUET_MAGIC), open_parquet),
    (lambda start: start.startswith(MDF_MAGICS), open_mdf),
    (lambda start: start.startswith(MCAP_MAGIC), open_mcap),
    (lambda start: start.startswith(TDMS_MAGIC), open_tdms),
    (lambda start: start.startswith(MAT5_MAGIC), open_mat),
    (lambda start: HDF5_MAGIC in (start[: len(HDF5_MAGIC)], start[HDF5_AT:]), open_mat73),
)


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
