"""Damaged checkpoints: told by what the commits add up to, and written again from them."""

from pathlib import Path

import numpy as np
import pytest
from deltalake import DeltaTable

from fleet_slip.errors import StorageError
from fleet_slip.operations.verify import repair, verify
from fleet_slip.storage.table import Change, Unit
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, path_of

COUNTS = {"ax": np.arange(5), "sideslip": np.arange(5)}
LATEST = "logs/_delta_log/_last_checkpoint"


@pytest.fixture
def log(warehouse: Warehouse) -> Path:
    """The log folder of a table with a unit that its checkpoint does not know."""
    land(warehouse, "one", log_rows("one", COUNTS))
    log = path_of(warehouse.root) / "logs" / "_delta_log"
    commit = log / f"{1:020}.json"
    content = commit.read_bytes()
    commit.write_bytes(content.replace(b'"appId":"test/one"', b'"appId":"test/ome"'))
    DeltaTable(str(log.parent)).create_checkpoint()
    commit.write_bytes(content)
    warehouse.logs.snapshot().commit(Change(units=[Unit("later", 1)]))
    return log


def damage(warehouse: Warehouse) -> set[str]:
    return {finding.path for finding in verify(warehouse).damage}


def test_a_checkpoint_is_written_again_from_the_commits(warehouse: Warehouse, log: Path) -> None:
    assert warehouse.logs.snapshot().landed("test/one") is None
    (finding,) = verify(warehouse).damage
    assert finding.path == LATEST
    assert finding.problem == "does not know what has landed: test/one"
    assert repair(warehouse, verify(warehouse)) == [LATEST]
    assert not damage(warehouse)
    for commit in log.glob("*.json"):
        commit.unlink()  # as Delta does after 30 days
    assert warehouse.logs.snapshot().landed("test/one") is not None


def test_a_checkpoint_that_cannot_be_read_is_written_again(warehouse: Warehouse, log: Path) -> None:
    (checkpoint,) = log.glob("*.checkpoint.parquet")
    checkpoint.write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    assert damage(warehouse) == {"logs"}
    assert repair(warehouse, verify(warehouse)) == ["logs"]
    assert not damage(warehouse)
    assert warehouse.logs.snapshot().rows == 5


def test_a_checkpoint_stays_where_its_commits_are_damaged(warehouse: Warehouse, log: Path) -> None:
    (log / f"{1:020}.json").unlink()
    (checkpoint,) = log.glob("*.checkpoint.parquet")
    checkpoint.write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    assert damage(warehouse) == {"logs"}
    with pytest.raises(StorageError, match="logs"):
        repair(warehouse, verify(warehouse))
    assert checkpoint.exists()
