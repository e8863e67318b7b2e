"""Rebuilds what can be rebuilt: Gram rows from the logs, and checkpoints from the commits.

Nothing is deleted. The bytes of a file that stand under another name are put back.
"""

import contextlib
from collections.abc import Collection, Set

import pyarrow as pa

from fleet_slip.errors import FleetSlipError, StorageError
from fleet_slip.grams.gram_files import is_of_received
from fleet_slip.grams.job import reconcile
from fleet_slip.operations.verify import Verification, read_whole
from fleet_slip.storage.checksums import checksum_in, checksum_of
from fleet_slip.storage.commits import LATEST, LOG, check_commits
from fleet_slip.storage.storage_errors import storage_errors
from fleet_slip.storage.table import Change, retrying
from fleet_slip.warehouse.tables import Warehouse


def repair(warehouse: Warehouse, verification: Verification) -> list[str]:
    """Rebuild what is damaged; return what, below the root."""
    logs = {finding.path for finding in verification.damage if finding.kind == "log"}
    rebuilt = _sum_up_again(warehouse, logs)
    damaged = {finding.path for finding in verification.damage if finding.kind == "file"}
    wrong = {f.path.removeprefix("logs/") for f in verification.damage if f.kind == "gram"}
    rebuilt += _find_elsewhere(warehouse, damaged)
    lost = {path.removeprefix("logs/") for path in damaged.difference(rebuilt)}
    rebuilt += _drop_wrong(warehouse, damaged, wrong)
    reconcile(warehouse, unreadable=lost)  # also what an interrupted repair has dropped
    return rebuilt


def _sum_up_again(warehouse: Warehouse, damaged: Set[str]) -> list[str]:
    """Write the checkpoints of damaged logs again whose commits are all there, and sound."""
    rebuilt = []
    for table in warehouse.tables:
        name, log = table.folder.name, table.folder / LOG
        found = damaged & {name, f"{name}/{LOG}/{LATEST}"}
        commits, faults = check_commits(log) if found else ([], {})
        if not commits or commits[0].version or faults:
            continue
        for file in log.files():
            if ".checkpoint." in file.name or file.name == LATEST:
                log.remove(file)
        delta = table.open_delta()
        if delta is not None:
            with storage_errors(table.folder):
                delta.create_checkpoint()
        rebuilt += sorted(found)
    return rebuilt


def _find_elsewhere(warehouse: Warehouse, damaged: Collection[str]) -> list[str]:
    """Put back the files whose very bytes a job or a person left under another name."""
    rebuilt = []
    for table in warehouse.tables:
        name = table.folder.name
        files = table.snapshot().files
        lost = [file for file in files if f"{name}/{file.path}" in damaged]
        sizes = {file.size_bytes for file in lost}
        for other in table.folder.files() if lost else ():
            if other.size_bytes not in sizes or other.path.startswith("_delta_log/"):
                continue
            with contextlib.suppress(StorageError):
                content = table.folder.read(other.path)
                for file in lost:
                    if checksum_in(file.path) == checksum_of(content):
                        table.folder.put(file.path, content)
                        rebuilt.append(f"{name}/{file.path}")
                lost = [file for file in lost if f"{name}/{file.path}" not in rebuilt]
    return rebuilt


@retrying
def _drop_wrong(warehouse: Warehouse, damaged: Collection[str], wrong: set[str]) -> list[str]:
    """Drop the Gram files that are damaged, or have wrong rows of log files; return them."""
    snapshot = warehouse.grams.snapshot()
    readable = _readable_grams(warehouse).items()
    named = {path: rows["file"].unique().to_pylist() for path, rows in readable}
    bad = [
        file
        for file in snapshot.files
        if (f"grams/{file.path}" in damaged and not is_of_received(file))
        or not wrong.isdisjoint(named.get(file.path, ()))
    ]
    if bad:
        snapshot.commit(Change(remove=bad, note={"job": "repair"}))
    return [f"grams/{file.path}" for file in bad]


def _readable_grams(warehouse: Warehouse) -> dict[str, pa.Table]:
    """Return which drives and log files the Gram files name, of those that are whole."""
    found = {}
    for file in warehouse.grams.snapshot().files:
        if read_whole(warehouse.grams, file).problem is None:
            with contextlib.suppress(FleetSlipError):
                found[file.path] = warehouse.grams.read(file.path, ["file", "drive_id"])
    return found
