"""Links and pipes where files belong: not followed, not truncated, not waited for."""

import os
import stat
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fleet_slip.errors import StorageError
from fleet_slip.models.registry import Registry
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import recording
from tests.support.commands import RunCommand
from tests.support.logs import ask
from tests.support.manifests import manifest, publish

Place = Callable[[Path], Path]


def a_link(file: Path) -> Path:
    """Put a link in a file's place, to a file of somebody else; return that."""
    other = file.with_name("of-somebody")
    other.write_text("precious")
    file.unlink(missing_ok=True)
    file.symlink_to(other)
    return other


def a_pipe(file: Path) -> Path:
    """Put a pipe that nobody writes to in a file's place."""
    file.unlink(missing_ok=True)
    os.mkfifo(file)
    return file


def untouched(other: Path) -> bool:
    return stat.S_ISFIFO(other.stat().st_mode) or other.read_text() == "precious"


@pytest.mark.parametrize("place", [a_link, a_pipe])
def test_a_lock_is_taken_on_a_file_only(
    tmp_path: Path, place: Place, run_command: RunCommand
) -> None:
    (tmp_path / "data").mkdir()
    other = place(tmp_path / "data/.run-smoke.lock")
    done = run_command("run", "--campaign", "smoke", "--days", "1")
    assert done.exit_code == StorageError.exit_code
    assert ".run-smoke.lock: a link, a folder or a pipe" in done.stderr
    assert untouched(other)


def test_a_lock_keeps_what_its_file_holds(tmp_path: Path) -> None:
    (tmp_path / "lock").write_text("who knows")
    with LocalFolder(tmp_path).exclusive("lock", lambda: None):
        pass
    assert (tmp_path / "lock").read_text() == "who knows"


@pytest.mark.parametrize("place", [a_link, a_pipe])
def test_the_history_is_written_to_files_only_and_read_from_files_only(
    tmp_path: Path, place: Place
) -> None:
    (tmp_path / "runs").mkdir()
    other = place(tmp_path / f"runs/{datetime.now(UTC):%Y-%m}.jsonl")
    if other.is_file():
        other.write_text('{"run_id":"of-another"}')
    with recording(LocalFolder(tmp_path), "gram", []):
        pass
    assert ask(tmp_path, "SELECT run_id FROM runs") == []
    if other.is_file():
        assert other.read_text() == '{"run_id":"of-another"}'


@pytest.mark.parametrize("place", [a_link, a_pipe])
@pytest.mark.parametrize("file", ["versions/1.json", "history/1.json"])
def test_a_document_is_read_from_a_file_only(
    tmp_path: Path, place: Place, file: str, run_command: RunCommand
) -> None:
    """Even a link to the very document: tomorrow it may lead to another."""
    publish(Registry(LocalFolder(tmp_path / "data/models")), manifest())
    document = tmp_path / "data/models/sideslip" / file
    content = document.read_text()
    other = place(document)
    if other.is_file():
        other.write_text(content)
    done = run_command("show", "sideslip")
    assert done.exit_code == StorageError.exit_code
    assert "a link, a folder or a pipe" in done.stderr


def test_a_data_file_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    a_pipe(tmp_path / "file.parquet")
    with pytest.raises(StorageError, match="no such file"):
        LocalFolder(tmp_path).open("file.parquet")
