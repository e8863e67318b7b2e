"""Reads from a Delta log at once which units of work have landed, for who has many to ask for.

The Delta library is asked for one at a time, and reads the log each time.
"""

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.delta.checkpoints import newest_checkpoint
from fleet_slip.delta.commits import COMMIT_FILE, LOG, commit_number, read_commit
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder


def read_landed_units(table: Folder, version: int) -> frozenset[str]:
    """Return the names of all units that have landed in a version of a table.

    Raises `StorageError` for a log that cannot be read.
    """
    log = table / LOG
    files = log.files()
    names: set[str] = set()
    checkpoint = newest_checkpoint(files, version)
    after = commit_number(checkpoint.name) if checkpoint else -1
    for file in files:  # a checkpoint may be of several
        if checkpoint and file.name.startswith(f"{after:020}.checkpoint."):
            with pq.ParquetFile(pa.BufferReader(log.read(file.name))) as parquet:
                told = parquet.read(columns=["txn.appId"])["txn"].combine_chunks()
            names.update(name for name in told.field("appId").to_pylist() if name is not None)
    for file in files:
        if COMMIT_FILE.fullmatch(file.name) and after < commit_number(file.name) <= version:
            try:
                commit = read_commit(log, file.name)
            except ValueError as error:
                raise StorageError(f"{file}: {error}") from None
            names.update(action["txn"]["appId"] for action in commit.actions if "txn" in action)
    return frozenset(names)
