"""How many rows a measured log may have, before it is read: for its progress."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.parquet_batches import PARQUET_MAGIC
from fleet_slip.ingest.logs.log_files import Log, parts_of

_SAMPLE_BYTES = 2**18


def expected_rows(log: Log) -> int:
    """Return about how many rows a log has; 0 where that is not known before all is read.

    A Parquet file says it, text has the lines of its begin throughout; objects are not asked.
    Never raises for what is wrong with the log: who reads it does.
    """
    if not isinstance(log, Path):
        return 0
    try:
        return sum(map(_expected, parts_of(log)))
    except (InputError, OSError, pa.ArrowException):
        return 0


def _expected(file: Path) -> int:
    with file.open("rb") as stream:
        sample = stream.read(_SAMPLE_BYTES)
    if sample.startswith(PARQUET_MAGIC):
        return int(pq.read_metadata(file).num_rows)
    lines = sample.count(b"\n") - 1  # without the header
    if b"\0" in sample or lines < 1:
        return 0
    return round(file.stat().st_size * lines / len(sample))
