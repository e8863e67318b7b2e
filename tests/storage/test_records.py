"""A changed line of the history is told from a torn one."""

import json
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.errors import StorageError
from fleet_slip.operations.verify import Verification, verify_documents
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import (
    find_changed_lines,
    publishable,
    read_lines,
    recording,
    runs_under_way,
    write_line,
)


@pytest.fixture
def history(tmp_path: Path) -> Path:
    """A file of two runs, four lines."""
    for command in ("gram", "publish"):
        with recording(LocalFolder(tmp_path), command, [command, "--cohort", "mass_kg > 1e3"]):
            pass
    (file,) = (tmp_path / "runs").iterdir()
    return file


def changed(file: Path) -> list[str]:
    return [problem for _, problem in find_changed_lines(LocalFolder(file.parents[1]))]


def test_every_flipped_bit_is_found(history: Path) -> None:
    whole = history.read_bytes()
    assert read_lines(whole)[1] == []
    missed = []
    for bit in range(len(whole) * 8):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        if not read_lines(bytes(damaged))[1]:
            missed.append(bit)
    assert missed == []


@pytest.mark.parametrize("place", [0.1, 0.5, 0.9, 0.99])
def test_a_flipped_bit_is_told_with_its_line(history: Path, place: float) -> None:
    content = bytearray(history.read_bytes())
    at = int(len(content) * place)
    at += content[at] == ord("\n")
    content[at] ^= 4
    line = bytes(content[:at]).count(b"\n") + 1
    history.write_bytes(content)
    report = Verification()
    verify_documents(LocalFolder(history.parents[1]), report)
    ((path, problem),) = [(one.path, one.problem) for one in report.damage]
    assert path == f"runs/{history.name}"
    assert f"line {line} " in problem


def test_readers_take_nothing_from_a_changed_line(history: Path) -> None:
    root = LocalFolder(history.parents[1])
    history.write_text(history.read_text().replace("mass_kg", "mess_kg", 1))
    with (
        pytest.raises(StorageError, match=r"line 2 .*or delete the line"),
        fleet_slip.connect(history.parents[1]) as database,
    ):
        database.sql("SELECT run_id FROM runs").fetchall()
    assert runs_under_way(root) == []
    lines = history.read_text().splitlines()
    history.write_text("\n".join(line for line in lines if "mess_kg" not in line) + "\n")
    with fleet_slip.connect(history.parents[1]) as database:
        assert len(database.sql("SELECT run_id FROM runs").fetchall()) == 2


def test_a_torn_line_is_no_damage_and_skipped(history: Path) -> None:
    whole = history.read_bytes()
    last = whole.rstrip().rpartition(b"\n")[2]
    for end in range(1, len(last) - 1):
        history.write_bytes(whole + b"\n" + last[:end])
        assert changed(history) == [], end


def test_a_line_without_a_checksum_is_changed(history: Path) -> None:
    record = json.loads(history.read_bytes().split(b"\n")[1])
    del record["sha256"]
    assert read_lines(json.dumps(record).encode()) == ([], [1])
    assert read_lines(write_line(record))[0]


def test_a_condition_on_a_car_is_not_kept() -> None:
    arguments = ["select", "--cohort", "vehicle_id = 'WVW1'", "--against=drive_id <> 'd'"]
    assert publishable(arguments) == ["select", "--cohort", "***", "***"]
