"""Opens measured files of any format: text and Parquet here, others by a confined process.

The first bytes identify the format; for text also the mapping and the file's suffix.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path, PosixPath

import polars as pl
import pyarrow as pa

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.confined import open_confined
from fleet_slip.ingest.formats.confined_reader import FORMATS
from fleet_slip.ingest.formats.csv import CsvSource
from fleet_slip.ingest.formats.file_formats import CsvFormat, FileFormats
from fleet_slip.ingest.formats.parquet_footer import MAGIC
from fleet_slip.ingest.formats.source import Budget, Source, unreadable
from fleet_slip.ingest.formats.tables import open_parquet
from fleet_slip.ingest.formats.vbo import VBO_BEGINS, VboSource

[_HDF5], _HDF5_AT = FORMATS["mat73"].begins, 512
"""A MATLAB file of version 7.3 becomes HDF5 there: MATLAB's own header is before it."""
_ARCHIVES = {b"PK\x03\x04": "unzip", b"7z\xbc\xaf": "7z x", b"Rar!": "unrar x"}
_BINARY = {
    (".parquet", ".pq"): "a Parquet file",
    (".mf4", ".mdf"): "an MDF file",
    (".mat", ".h5", ".hdf5"): "a MATLAB file of version 5 or 7.3",
    (".mcap",): "an MCAP file",
    (".tdms", ".tdms_index"): "a TDMS file",
}


class StrayLink(PosixPath):
    """A file or folder behind a link out of its folder, which is refused."""


@contextmanager
def require_unchanged_log(log: Path) -> Iterator[None]:
    """Raise `InputError` if a log is no regular file of its folder, or changes while it is read."""
    if isinstance(log, StrayLink):
        raise InputError(
            f"{quote_name(log)}: a symbolic link out of its folder, not followed. Give the file by "
            "its "
            "own path."
        )
    if not log.is_file():
        problem = "is not a regular file" if log.exists() else "no such file"
        raise InputError(f"{quote_name(log)}: {problem}. Give the path of a file.")
    before = _size_and_time(log)
    yield
    if _size_and_time(log) != before:
        raise InputError(
            f"{quote_name(log)}: it changed while it was read. Wait until it is complete."
        )


def _size_and_time(file: Path) -> tuple[int, int]:
    with file_errors(file):
        return file.stat().st_size, file.stat().st_mtime_ns


def open_source(file: Path, formats: FileFormats) -> AbstractContextManager[Source]:
    """Open a file in the format that its first bytes identify. Raises `InputError`.

    Each format ensures that the file needs no other file, that no value is a program, and that the
    decoded file does not exceed its `Budget`.
    """
    budget = Budget.for_file(file)
    with file.open("rb") as stream:
        start = stream.read(_HDF5_AT + len(_HDF5))
    for magic, program in _ARCHIVES.items():
        if start.startswith(magic):
            raise InputError(
                f"{quote_name(file)}: it is an archive. Unpack it with {program} and give the "
                "files."
            )
    suffix = file.suffix.lower()
    begun = start[_HDF5_AT:] if start.endswith(_HDF5) else start
    name = next(
        (name for name, file_format in FORMATS.items() if begun.startswith(file_format.begins)), ""
    )
    if formats.can is not None:
        name = "mdf_bus" if name == "mdf" else name or "can_trace"
    elif suffix in {".blf", ".asc"}:
        name = name or "can_trace"
    if start.startswith(MAGIC):
        return open_parquet(budget)
    if name:
        return open_confined(name, budget, formats)
    for suffixes, kind in _BINARY.items():
        if suffix in suffixes:
            raise InputError(
                f"{quote_name(file)}: not {kind}, despite its suffix. Export it again, or correct "
                "the "
                "suffix."
            )
    if VBO_BEGINS.match(start) and formats.csv == CsvFormat():
        return nullcontext(VboSource(budget, formats.plain_numbers))
    return nullcontext(CsvSource(budget, formats.csv, formats.plain_numbers))


@contextmanager
def file_errors(file: Path) -> Iterator[None]:
    """Convert errors of the operating system, Polars and pyarrow to an `InputError`."""
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
        raise unreadable(file, error) from None
