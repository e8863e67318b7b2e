"""The history of runs."""

import logging
import os
import socket
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.errors import HIDDEN, InputError, StorageError
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import (
    current_run_id,
    find_changed_lines,
    process_began,
    publishable,
    read_lines,
    recording,
    runs_under_way,
    state_of,
    step,
    write_line,
)
from tests.support.commands import RunCommand, finish, start
from tests.support.logs import ask


def runs(root: Path) -> list[dict[str, Any]]:
    with fleet_slip.connect(root, query="runs") as database:
        rows = database.sql("FROM runs ORDER BY run_id").to_arrow_table().to_pylist()
    return list(rows)


def test_a_run_is_two_lines_and_one_row(tmp_path: Path) -> None:
    with recording(LocalFolder(tmp_path), "simulate", ["simulate", "smoke"]) as run:
        assert current_run_id() == run.run_id
        assert runs(tmp_path)[0]["outcome"] is None
        with step("simulate") as figures:
            figures.rows, figures.size_bytes = 100, 950
        with step("gram") as figures:
            figures.rows = 70
    assert current_run_id() is None
    (row,) = runs(tmp_path)
    assert (row["run_id"], row["command"]) == (run.run_id, "simulate")
    assert row["arguments"] == ["simulate", "smoke"]
    assert (row["outcome"], row["exit_code"], row["error"]) == ("done", 0, None)
    assert (row["rows"], row["size_bytes"], row["process"]) == (100, 950, os.getpid())
    assert [entry["name"] for entry in row["steps"]] == ["simulate", "gram"]
    assert row["started_at"] == run.started_at
    assert row["ended_at"] >= row["started_at"]


def test_a_failure_is_recorded_with_its_exit_code_and_raised(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError),
        recording(LocalFolder(tmp_path), "ingest", ["ingest", "/data/anna.csv"]),
        step("ingest"),
    ):
        raise InputError("/data/anna.csv: no such file.")
    with pytest.raises(KeyboardInterrupt), recording(LocalFolder(tmp_path), "gram", []):
        raise KeyboardInterrupt
    failed, interrupted = runs(tmp_path)
    assert (failed["outcome"], failed["exit_code"]) == ("failed", 4)
    assert failed["error"] == f"{HIDDEN}.csv: no such file."
    assert [entry["name"] for entry in failed["steps"]] == ["ingest"]
    assert (interrupted["outcome"], interrupted["exit_code"]) == ("interrupted", 130)


def test_a_data_root_that_does_not_exist_is_not_made(tmp_path: Path) -> None:
    with recording(LocalFolder(tmp_path / "data"), "gram", []):
        pass
    assert not (tmp_path / "data").exists()
    with recording(LocalFolder(tmp_path / "data"), "simulate", []):
        (tmp_path / "data").mkdir()
    assert [row["outcome"] for row in runs(tmp_path / "data")] == ["done"]


def test_an_unwritable_record_does_not_fail_the_command(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "runs").write_text("a file where the folder should be")
    logging.getLogger("fleet_slip").propagate = True
    with recording(LocalFolder(tmp_path), "gram", []):
        pass
    assert "the run history cannot be written" in caplog.text
    assert runs(tmp_path) == []


def test_processes_at_once_lose_no_record(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from fleet_slip.storage.local import LocalFolder\n"
        "from fleet_slip.storage.runs import recording\n"
        "for i in range(100):\n"
        "    with recording(LocalFolder(Path(sys.argv[1])), 'gram', ['x' * i]): pass"
    )
    writers = [start([sys.executable, "-c", code, str(tmp_path)]) for _ in range(3)]
    assert [writer.exit_code for writer in finish(*writers)] == [0] * 3
    rows = runs(tmp_path)
    assert len(rows) == 300
    assert {row["outcome"] for row in rows} == {"done"}


@pytest.mark.parametrize(
    ("arguments", "recorded"),
    [
        ("publish --signing-key hunter2 --force", "publish --signing-key *** --force"),
        ("--api-token=abc s3://me:pw@bucket/x", "--api-token=*** s3://***@bucket/x"),
        ("https://h/p?a=1&X-Amz-Signature=PW", "https://h/p?a=1&X-Amz-Signature=***"),
        ("s3://bucket/a@b day>='2024-05-01'", "s3://bucket/a@b day>='2024-05-01'"),
        ("--vehicle WVW1 --drive=d a/WVW1.csv.gz", "--vehicle *** --drive=*** ***.csv.gz"),
        ("--cohort vehicle_id='WVW1' --against=drive_id<>'d'", "--cohort *** ***"),
        ("bad\udcff", "bad?"),
    ],
)
def test_secrets_and_names_of_cars_are_not_kept(arguments: str, recorded: str) -> None:
    assert publishable(arguments.split()) == recorded.split()


@pytest.mark.parametrize(
    "url", ["tcp://u:PW@h:1", "tcp://u:P/W@h:1", "tcp://u:P@W@h:1", "TCP://u:P W@h:1", "u:PW@h:1"]
)
def test_users_and_passwords_of_addresses_are_not_kept(url: str) -> None:
    hidden = url.partition("//")[0] + "//***@h:1" if "//" in url else "***@h:1"
    assert publishable(["--cluster", url]) == ["--cluster", hidden]
    assert publishable([f"--cluster={url}"]) == [f"--cluster={hidden}"]
    assert "PW" not in str(StorageError(f"no answer of {url} in 30 s").args) or "//" not in url


def test_commands_are_recorded_and_questions_are_not(run_command: RunCommand) -> None:
    run_command("run", "--campaign", "smoke", "--days", "1", "--models", "table1")
    run_command("gram", "--features", "unknown")
    run_command("sql", "FROM drives")
    run_command("run", "--no-such-option")
    query = "SELECT command, exit_code, rows, outcome, [s.name FOR s IN steps] AS steps FROM runs"
    done, failed = run_command("sql", f"{query} ORDER BY started_at", "--json").json
    steps = ["simulate", "gram", "select", "publish"]
    assert (done["command"], done["exit_code"], done["steps"]) == ("run", 0, steps)
    assert done["rows"] > 10_000
    assert (failed["command"], failed["exit_code"], failed["outcome"]) == ("gram", 5, "failed")


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
    content = history.read_bytes()
    assert read_lines(content)[1] == []
    missed = []
    for bit in range(len(content) * 8):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        if not read_lines(bytes(damaged))[1]:
            missed.append(bit)
    assert missed == []


def test_readers_take_nothing_from_a_changed_line(history: Path) -> None:
    root = LocalFolder(history.parents[1])
    history.write_text(history.read_text().replace("mass_kg", "mess_kg", 1))
    with pytest.raises(StorageError, match=r"line 2 .*or delete the line"):
        ask(history.parents[1], "SELECT run_id FROM runs")
    assert runs_under_way(root) == []
    lines = history.read_text().splitlines()
    history.write_text("\n".join(line for line in lines if "mess_kg" not in line) + "\n")
    assert len(ask(history.parents[1], "SELECT run_id FROM runs")) == 2


def test_a_torn_line_is_damage(history: Path) -> None:
    content = history.read_bytes()
    history.write_bytes(content + b"\n" + content.split(b"\n")[1][:40])
    assert len(changed(history)) == 1


def run_of(**changes: Any) -> dict[str, Any]:
    """A run of this process, under way."""
    me = {"host": socket.gethostname(), "process": os.getpid(), "outcome": None}
    return {**me, "process_began": process_began(os.getpid()), **changes}


def test_processes_of_one_number_are_told_apart() -> None:
    began = process_began(os.getpid())
    assert began == process_began(os.getpid())
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        theirs = process_began(other.pid)
        other.communicate()
    assert None is not began != theirs is not None
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


def under_way(tmp_path: Path, *runs: dict[str, Any]) -> list[str]:
    """Return the runs under way of a root with the beginnings of some runs."""
    lines = b"".join(write_line(run_of(**run)) + b"\n" for run in runs)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / f"{datetime.now(UTC):%Y-%m}.jsonl").write_bytes(lines)
    return runs_under_way(LocalFolder(tmp_path))


def test_a_killed_run_whose_number_another_process_has_is_not_under_way(tmp_path: Path) -> None:
    names = [f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}-{letter * 8}" for letter in "ab"]
    killed = {"run_id": names[0], "process_began": "another boot/7"}
    assert under_way(tmp_path, killed, {"run_id": names[1]}) == names[1:]


def test_a_live_run_of_this_machine_is_under_way_whatever_the_clock_says(tmp_path: Path) -> None:
    hosts = (socket.gethostname(), "elsewhere")
    began = f"{datetime.now(UTC) - timedelta(hours=30):%Y%m%dT%H%M%S.%fZ}"
    runs = [{"run_id": f"{began}-{host}", "host": host} for host in hosts]
    assert under_way(tmp_path, *runs) == [f"{began}-{hosts[0]}"]
