"""Flipped bits anywhere in a Delta log: found, or without consequence."""

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deltalake import DeltaTable

from fleet_slip.grams.update import update_grams
from fleet_slip.operations.rewriting import compact
from fleet_slip.operations.verify import repair, verify
from fleet_slip.storage.commits import find_commit_faults
from fleet_slip.storage.table import AppTransaction, Change
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.logs import DAY, land, log_rows
from tests.support.once import filled_once

COUNTS = {"ax": np.arange(5), "sideslip": np.arange(5)}


@pytest.fixture
@filled_once
def root(warehouse: Warehouse) -> None:
    """Logs that were made, appended to twice and compacted."""
    for name in ("one", "two"):
        land(warehouse, name, log_rows(name, COUNTS))
    update_grams(warehouse)
    compact(warehouse)


def logs_of(warehouse: Warehouse) -> Path:
    return Path(warehouse.logs.folder.uri)


def commits(warehouse: Warehouse) -> list[Path]:
    return sorted(logs_of(warehouse).glob("_delta_log/*.json"))


def problems(warehouse: Warehouse) -> dict[str, str]:
    return {f.path: f.problem for f in verify(warehouse).findings if f.kind == "log"}


def consequences(content: bytes) -> Any:
    """The actions of a commit, without the Delta library's remarks on time, program and mode.

    The note of the commit that only makes the table has nothing to tell but its own checksum.
    """
    actions = [json.loads(line) for line in content.splitlines()]
    done = [action for action in actions if "commitInfo" not in action]
    (info,) = (action["commitInfo"] for action in actions if "commitInfo" in action)
    tidy = [{k: _without_nulls(v) for k, v in action.items()} for action in done]
    sealed = any(not action.keys() <= {"metaData", "protocol"} for action in done)
    return sorted(map(str, tidy)), json.loads(info["fleet_slip"]) if sealed else None


def _without_nulls(content: dict[str, Any]) -> dict[str, Any]:
    fields = {k: v for k, v in content.items() if v is not None}
    return {k: v for k, v in sorted(fields.items()) if "xtendedFileMetadata" not in str(fields)}


def test_sound_logs_have_no_problems(root: Warehouse) -> None:
    assert [list(find_commit_faults(table.snapshot())) for table in root.tables] == [[], [], []]
    assert all(b"sha256" in file.read_bytes() for file in commits(root))


def test_every_bit_of_a_log_that_has_consequences_is_guarded(root: Warehouse) -> None:
    rng = random.Random(0)  # noqa: S311
    snapshot = root.logs.snapshot()
    _ = snapshot.files
    for file in commits(root):
        content = file.read_bytes()
        done = consequences(content)
        for bit in rng.sample(range(8 * len(content)), 150):
            damaged = bytearray(content)
            damaged[bit // 8] ^= 1 << bit % 8
            file.write_bytes(damaged)
            if not any(name == file.name for name, _ in find_commit_faults(snapshot)):
                assert consequences(bytes(damaged)) == done, damaged[bit // 8 - 40 : bit // 8 + 40]
        file.write_bytes(content)


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("commit", "old", "new", "problem"),
    [
        (1, "test/one", "test/ome", "does not match the checksum"),
        (1, '\\"sha256', '\\"sha255', "states no checksum"),
        (1, '"fleet_slip"', '"fleet_slop"', "states no checksum"),
        (1, '"txn"', '"uxn"', "never writes"),
        (3, '"job', '"jbb', "does not match the checksum"),
        (0, '"name":"logs"', '"name":"logr"', "twice, differently"),
    ],
)
def test_damage_that_no_other_check_sees_is_told(
    root: Warehouse, commit: int, old: str, new: str, problem: str
) -> None:
    file = commits(root)[commit]
    change(file, old, new)
    DeltaTable(str(logs_of(root)))  # Delta reads it as if nothing had happened
    assert problem in problems(root)[f"logs/_delta_log/{file.name}"]


def test_a_commit_that_is_gone_is_told(root: Warehouse) -> None:
    DeltaTable(str(logs_of(root))).create_checkpoint()
    commits(root)[2].unlink()
    assert "logs/_delta_log/00000000000000000002.json" in problems(root)


def test_units_and_notes_of_any_text_are_sealed_as_they_are(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("x", log_rows("x", COUNTS), DAY)
    transaction = AppTransaction('"\\ é \u2028 1', 2**62)
    warehouse.logs.snapshot().commit(
        Change(add=[action], transactions=[transaction], note={"job": "ü\n"})
    )
    assert not problems(warehouse)


LATEST = "logs/_delta_log/_last_checkpoint"


@pytest.fixture
@filled_once
def later(warehouse: Warehouse) -> None:
    """A table with a transaction that its checkpoint does not know."""
    land(warehouse, "one", log_rows("one", COUNTS))
    commit = commits(warehouse)[1]
    content = commit.read_bytes()
    commit.write_bytes(content.replace(b'"appId":"test/one"', b'"appId":"test/ome"'))
    DeltaTable(str(logs_of(warehouse))).create_checkpoint()
    commit.write_bytes(content)
    warehouse.logs.snapshot().commit(Change(transactions=[AppTransaction("later", 1)]))


def damage(warehouse: Warehouse) -> set[str]:
    return {finding.path for finding in verify(warehouse).damage}


def test_a_checkpoint_is_written_again_from_the_commits(later: Warehouse) -> None:
    assert later.logs.snapshot().transaction_version("test/one") is None
    (finding,) = verify(later).damage
    assert finding.path == LATEST
    assert finding.problem == "does not know what has landed: test/one"
    assert repair(later, verify(later)) == [LATEST]
    assert not damage(later)
    for commit in commits(later):
        commit.unlink()  # as Delta does after 30 days
    assert later.logs.snapshot().transaction_version("test/one") is not None


def test_a_checkpoint_that_cannot_be_read_is_written_again(later: Warehouse) -> None:
    (checkpoint,) = logs_of(later).glob("_delta_log/*.checkpoint.parquet")
    checkpoint.write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    assert damage(later) == {"logs"}
    assert repair(later, verify(later)) == ["logs"]
    assert not damage(later)
    assert later.logs.snapshot().rows == 5


def test_a_checkpoint_stays_where_its_commits_are_damaged(later: Warehouse) -> None:
    commits(later)[1].unlink()
    (checkpoint,) = logs_of(later).glob("_delta_log/*.checkpoint.parquet")
    checkpoint.write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    assert damage(later) == {"logs"}
    assert not repair(later, verify(later))
    assert damage(later) == {"logs"}
    assert checkpoint.exists()
