"""Whether the process of a run is still there, whoever has its number by now."""

import os
import socket
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from fleet_slip.storage import runs as records
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import process_began, runs_under_way, state_of, write_line


def run_of(**changes: Any) -> dict[str, Any]:
    """A run of this process, under way."""
    me = {"host": socket.gethostname(), "process": os.getpid(), "outcome": None}
    return {**me, "process_began": process_began(os.getpid()), **changes}


def test_processes_of_one_number_are_told_apart() -> None:
    mine = process_began(os.getpid())
    assert mine == process_began(os.getpid())
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        theirs = process_began(other.pid)
        other.communicate()
    assert None is not mine != theirs is not None
    assert process_began(other.pid) != theirs


@pytest.mark.parametrize(
    ("changes", "state"),
    [
        ({}, "running"),
        ({"process_began": "another boot/7"}, "killed"),
        ({"process_began": None}, "running"),  # of an earlier version
        ({"outcome": "done"}, "done"),
        ({"host": "another", "process_began": "another boot/7"}, "running"),
        ({"process": None, "process_began": None}, "running"),
    ],
)
def test_the_state_of_a_run(changes: dict[str, Any], state: str) -> None:
    assert state_of(run_of(**changes)) == state


def test_where_the_system_does_not_tell_a_run_counts_as_running(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorded = run_of()
    monkeypatch.setattr(records, "PROC", tmp_path)
    assert process_began(os.getpid()) is None
    assert state_of(recorded) == "running"


def test_a_killed_run_whose_number_another_process_has_is_not_under_way(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    names = [f"{now:%Y%m%dT%H%M%S.%fZ}-{letter * 8}" for letter in "ab"]
    begun = ["another boot/7", process_began(os.getpid())]
    lines = [
        write_line(run_of(run_id=name, command="publish", process_began=at))
        for name, at in zip(names, begun, strict=True)
    ]
    folder = tmp_path / "runs"
    folder.mkdir()
    (folder / f"{now:%Y-%m}.jsonl").write_bytes(b"\n".join(lines) + b"\n")
    assert runs_under_way(LocalFolder(tmp_path)) == names[1:]
