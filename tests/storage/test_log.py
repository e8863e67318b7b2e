"""The history of runs."""

import logging
import os
import sys
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.errors import HIDDEN, InputError, StorageError
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import current_run_id, publishable, recording, step
from tests.support.commands import RunCommand, finish, start


def runs(root: Path) -> list[dict[str, Any]]:
    with fleet_slip.connect(root) as database:
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
    assert (row["run_id"], row["command"], row["arguments"]) == (
        run.run_id,
        "simulate",
        ["simulate", "smoke"],
    )
    assert (row["outcome"], row["exit_code"], row["error"]) == ("done", 0, None)
    assert (row["rows"], row["size_bytes"], row["process"]) == (100, 950, os.getpid())
    assert [one["name"] for one in row["steps"]] == ["simulate", "gram"]
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
    assert failed["error"] == f"{HIDDEN}: no such file."
    assert [one["name"] for one in failed["steps"]] == ["ingest"]
    assert (interrupted["outcome"], interrupted["exit_code"]) == ("interrupted", 130)


def test_a_data_root_that_does_not_exist_is_not_made(tmp_path: Path) -> None:
    with recording(LocalFolder(tmp_path / "data"), "gram", []):
        pass
    assert not (tmp_path / "data").exists()
    with recording(LocalFolder(tmp_path / "data"), "simulate", []):
        (tmp_path / "data").mkdir()
    assert [row["outcome"] for row in runs(tmp_path / "data")] == ["done"]


def test_what_cannot_be_recorded_does_not_fail_the_command(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "runs").write_text("a file where the folder should be")
    logging.getLogger("fleet_slip").propagate = True
    with recording(LocalFolder(tmp_path), "gram", []):
        pass
    assert "the history of runs cannot be written" in caplog.text
    assert runs(tmp_path) == []


def test_processes_at_once_lose_no_record(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from fleet_slip.storage.local import LocalFolder\n"
        "from fleet_slip.storage.runs import recording\n"
        "for i in range(100):\n"
        "    with recording(LocalFolder(Path(sys.argv[1])), 'gram', ['x' * i]): pass"
    )
    writers = [start([sys.executable, "-c", code, str(tmp_path)]) for _ in range(4)]
    assert [writer.exit_code for writer in finish(*writers)] == [0] * 4
    rows = runs(tmp_path)
    assert len(rows) == 400
    assert {row["outcome"] for row in rows} == {"done"}


def test_secrets_and_names_of_cars_are_not_kept() -> None:
    assert publishable(
        ["publish", "--signing-key", "hunter2", "--api-token=abc", "s3://me:pw@bucket/x", "--force"]
    ) == ["publish", "--signing-key", "***", "--api-token=***", "s3://***@bucket/x", "--force"]
    for url in (
        "tcp://u:PW@h:1",
        "tcp://u:P/W@h:1",
        "tcp://u:P@W@h:1",
        "TCP://u:P W@h:1",
        "u:PW@h:1",
    ):
        hidden = url.partition("//")[0] + "//***@h:1" if "//" in url else "***@h:1"
        assert publishable(["--cluster", url]) == ["--cluster", hidden]
        assert publishable([f"--cluster={url}"]) == [f"--cluster={hidden}"]
    assert publishable(["https://h/p?a=1&X-Amz-Signature=PW"]) == [
        "https://h/p?a=1&X-Amz-Signature=***"
    ]
    assert publishable(["s3://bucket/a@b", "day >= '2024-05-01'"]) == [
        *("s3://bucket/a@b", "day >= '2024-05-01'")
    ]
    assert publishable(["forget", "--vehicle", "WVW1", "--drive=d", "a/WVW1.csv.gz"]) == [
        "forget",
        "--vehicle",
        "***",
        "--drive=***",
        "***.csv.gz",
    ]
    assert "PW" not in str(StorageError("no answer of tcp://u:P/W@h:1 in 30 s").args)
    assert publishable(["bad \udcff name"]) == ["bad ? name"]


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
