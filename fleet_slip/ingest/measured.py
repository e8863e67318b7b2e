"""A measured file as a whole: drives in counts, and a quarantine of the rest."""

from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from fleet_slip.ingest.drives.stream import open_measured
from fleet_slip.ingest.drives.totals import IngestCounts
from fleet_slip.ingest.landing.log_table import log_table
from fleet_slip.ingest.mapping.mapping import Mapping


@dataclass(frozen=True)
class MeasuredLog:
    """A measured file, ready for the warehouse."""

    drives: pa.Table
    """The catalogue's `log_schema`, of extras those that are mapped, by drive_id, then tick.

    Strings are dictionary-encoded.
    """
    quarantine: pa.Table
    """`QUARANTINE_SCHEMA`, in the file's order."""
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...]
    """Names of drives or cars in the file that differ only in their Unicode form."""
    digest: str
    """SHA-256 of the file's bytes and the mapping: what has the same one was ingested before."""


def read_measured(file: Path, mapping: Mapping) -> MeasuredLog:
    """Read a file through a mapping, all of it into memory; see `MeasuredStream`.

    Raises `InputError` if the file cannot be read, is not what the mapping says, or has no usable
    row.
    """
    with open_measured(file, mapping) as stream:
        pieces = list(stream.pieces())
    drives = sorted((d for piece in pieces for d in piece.drives), key=lambda d: d.drive_id)
    return MeasuredLog(
        log_table(drives, mapping),
        stream.quarantine_table([piece.refused for piece in pieces]),
        stream.counts(),
        stream.look_alikes(),
        stream.digest,
    )
