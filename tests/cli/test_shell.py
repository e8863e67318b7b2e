"""The shell: statements, its own commands, completion, and the lines that it keeps."""

import os
import pty
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.session import Session
from fleet_slip.cli.data.shell_command import Typed, complete
from tests.support.commands import COMMAND, PATIENCE_S, Finished, RunCommand


@pytest.fixture
def session(smoke_root: Path) -> Iterator[Session]:
    with fleet_slip.open(smoke_root).session() as opened:
        yield opened


def typed(run_command: RunCommand, root: Path, *lines: str) -> Finished:
    return run_command("shell", root=root, input="\n".join(lines) + "\n")


def test_it_answers_statements_and_survives_mistakes(
    run_command: RunCommand, smoke_root: Path
) -> None:
    lines = ["SELECT count(*) AS drives", "FROM drives;", "SELEC;", "SELECT 41 + 1 AS answer;"]
    done = typed(run_command, smoke_root, *lines, ".quit", "SELECT 'after the end';")
    assert done.exit_code == 0
    assert "answer" in done.stdout
    assert "42" in done.stdout
    assert "slip>" not in done.stdout
    assert "after the end" not in done.stdout
    assert "error: not valid SQL" in done.stderr


def test_its_commands(run_command: RunCommand, smoke_root: Path) -> None:
    lines = [".tables", ".schema drives", ".mode csv", "SELECT 'a,b' AS text;", ".mode json;"]
    lines += ["SELECT 7 AS seven;", ".mode xml", ".schema nothing", ".sing", ".help"]
    done = typed(run_command, smoke_root, *lines)
    assert done.exit_code == 0
    for found in ("log_counts\n", "adhesion", '"text"\n"a,b"', '"seven": 7', ".schema  VIEW"):
        assert found in done.stdout, found
    assert done.stderr.count("error: ") == 3
    assert "there is no view nothing" in done.stderr


def test_a_name_of_a_view_is_no_sql(
    session: Session, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(
        "fleet_slip.cli.data.shell_command.answer", lambda *given: asked.append(given[1])
    )
    typed = Typed(session)
    assert typed.obey(".schema grams")
    assert typed.obey(".schema x' OR '1' = '1")
    (only,) = asked
    assert only.endswith("FROM dictionary WHERE \"view\" = 'grams'")


def test_tab_completes_views_columns_and_commands(session: Session) -> None:
    words = Typed(session).words()
    found = [complete(words, "sidesl", number) for number in range(3)]
    assert found == ["sideslip", "sideslip_rad", None]
    assert complete(words, "log_c", 0) == "log_counts"
    assert complete(words, ".sch", 0) == ".schema"
    assert complete(words, "SIDESLIP_", 0) == "sideslip_rad"


def at_a_terminal(root: Path, typed: str, **environment: str) -> str:
    """Type at a terminal; return what it shows."""
    mine, its = pty.openpty()
    try:
        os.write(mine, typed.encode())
        words = [COMMAND, "--root", str(root), "--log", "text", "shell"]
        done = subprocess.run(
            words,
            stdin=its,
            stdout=its,
            stderr=subprocess.PIPE,
            check=False,
            timeout=PATIENCE_S,
            env={**os.environ, "TERM": "dumb", **environment},
        )
        assert done.returncode == 0, done.stderr
        return os.read(mine, 2**16).decode()  # little enough to wait there until it is read
    finally:
        os.close(mine)
        os.close(its)


def test_what_was_typed_is_kept_for_this_user_alone(smoke_root: Path, tmp_path: Path) -> None:
    at_a_terminal(smoke_root, "SELECT 42;\n.quit\n", XDG_STATE_HOME=str(tmp_path))
    file = tmp_path / "fleet_slip" / "shell_history"
    assert file.read_text().splitlines() == ["SELECT 42;", ".quit"]
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    at_a_terminal(smoke_root, "SELECT 43;\n.quit\n", XDG_STATE_HOME=str(tmp_path))
    assert file.read_text().splitlines() == ["SELECT 42;", ".quit", "SELECT 43;", ".quit"]


def test_where_nothing_can_be_kept_it_works_all_the_same(smoke_root: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    shown = at_a_terminal(smoke_root, "SELECT 42;\n.quit\n", XDG_STATE_HOME=str(file / "x"))
    assert "42" in shown
