"""Flipped bits in checkpoints, also when the commits before them were cleaned away."""

import random
from pathlib import Path

import numpy as np
import pytest
from deltalake import DeltaTable

from fleet_slip.operations.repair import repair
from fleet_slip.operations.verify import verify
from fleet_slip.storage.commits import (
    checkpoint_faults,
    checkpoints_without_checksum,
    kept_checksums,
)
from fleet_slip.storage.table import Change, Unit
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, path_of

COUNTS = {"ax": np.arange(5), "sideslip": np.arange(5)}
INTERVAL = 100
"""Commits between two checkpoints of the Delta library."""


@pytest.fixture
def log(warehouse: Warehouse) -> Path:
    """The log folder of a table whose hundredth commit has made a checkpoint."""
    land(warehouse, "one", log_rows("one", COUNTS))
    for number in range(INTERVAL - 2):
        warehouse.logs.snapshot().commit(Change(units=[Unit(f"unit {number}", number)]))
    return path_of(warehouse.root) / "logs" / "_delta_log"


def checkpoint_in(log: Path) -> Path:
    (checkpoint,) = log.glob("*.checkpoint.parquet")
    return checkpoint


def clean(log: Path) -> None:
    """Remove the commits that the checkpoint sums up, as Delta does after 30 days."""
    for commit in log.glob("*.json"):
        if int(commit.stem) <= int(checkpoint_in(log).name[:20]):
            commit.unlink()


def flip(file: Path, bit: int) -> None:
    content = bytearray(file.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)


def damage(warehouse: Warehouse) -> set[str]:
    return {finding.path for finding in verify(warehouse).damage}


def test_every_flipped_bit_is_found_without_the_commits(warehouse: Warehouse, log: Path) -> None:
    assert kept_checksums(warehouse.logs.folder).keys() == {checkpoint_in(log).name}
    warehouse.logs.snapshot().commit(Change(units=[Unit("later", 1)]))
    clean(log)
    assert not damage(warehouse)
    checkpoint = checkpoint_in(log)
    content = checkpoint.read_bytes()
    for bit in random.Random(0).sample(range(8 * len(content)), 200):  # noqa: S311
        flip(checkpoint, bit)
        assert [name for name, _ in checkpoint_faults(warehouse.logs.folder)]
        checkpoint.write_bytes(content)
    flip(checkpoint, 8 * (len(content) // 2))
    assert f"logs/_delta_log/{checkpoint.name}" in damage(warehouse)
    repair(warehouse, verify(warehouse))
    assert f"logs/_delta_log/{checkpoint.name}" in damage(warehouse)
    assert checkpoint.exists()


def test_a_checkpoint_is_written_again_from_the_commits(warehouse: Warehouse, log: Path) -> None:
    checkpoint = checkpoint_in(log)
    flip(checkpoint, 4000)
    assert f"logs/_delta_log/{checkpoint.name}" in damage(warehouse)
    assert f"logs/_delta_log/{checkpoint.name}" in repair(warehouse, verify(warehouse))
    assert not damage(warehouse)
    assert warehouse.logs.snapshot().landed("unit 97") == 97
    clean(log)
    assert warehouse.logs.snapshot().landed("unit 97") == 97


def test_a_checkpoint_of_another_program_is_told_and_sealed_with_the_next(
    warehouse: Warehouse,
) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    folder = warehouse.logs.folder
    DeltaTable(folder.uri).create_checkpoint()
    (name,) = checkpoints_without_checksum(folder)
    told = {finding.path for finding in verify(warehouse).findings}
    assert f"logs/_delta_log/{name}" in told
    assert not damage(warehouse)
    before = warehouse.logs.snapshot()
    warehouse.logs.snapshot().commit(Change(units=[Unit("a", 1)]))
    DeltaTable(folder.uri).create_checkpoint()
    before.commit(Change(units=[Unit("b", 1)]))
    assert checkpoints_without_checksum(folder) == []
