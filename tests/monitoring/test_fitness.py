"""Whether a machine and a data root are fit: what is not, is found and said."""

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fleet_slip.errors import ClusterError
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.monitoring import fitness
from fleet_slip.monitoring.fitness import examine_fitness
from tests.support.commands import RunCommand


def found(root: Path, subject: str, **options: Any) -> fitness.Finding:
    [one] = [
        one
        for one in examine_fitness(LocalFolder(root), **options).examined
        if one.subject == subject
    ]
    return one


def test_a_root_that_works_is_fit_and_the_probe_is_gone(tmp_path: Path) -> None:
    assert found(tmp_path, f"data root {tmp_path}").fit
    assert list(tmp_path.iterdir()) == []


def test_a_root_that_is_a_file_is_not(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    one = found(file, f"data root {file}")
    assert not one.fit
    assert str(file) in one.advice


def make_again(path: str, content: bytes) -> bool:
    """What a store does that does not know conditions: it takes the second file too."""
    return True


@pytest.mark.parametrize(
    ("name", "broken", "advice"),
    [
        ("create", make_again, "keep a file from being made twice"),
        ("read", lambda path: b"other", "what was written is not what is read"),
        ("files", list, "not listed"),
    ],
)
def test_a_root_that_does_not_keep_its_promises_is_not(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    broken: Callable[..., Any],
    advice: str,
) -> None:
    monkeypatch.setattr(LocalFolder, name, lambda self, *given: broken(*given))
    assert advice in found(tmp_path, f"data root {tmp_path}").advice


def test_a_clock_that_is_off_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() - 3600)
    one = found(tmp_path, "clock")
    assert one.found.startswith("3600 s") or one.found.startswith("3601 s")
    assert not one.fit


def test_little_memory_and_few_files_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fitness, "memory_bytes", lambda: 2**29)
    monkeypatch.setattr(resource, "getrlimit", lambda what: (100, 100))
    assert "1 GiB" in found(tmp_path, "memory").advice
    assert "ulimit -n 1024" in found(tmp_path, "open files").advice


def test_a_cluster_that_is_not_there_is_found(tmp_path: Path) -> None:
    def fail() -> int:
        raise ClusterError("tcp://x:1: nobody answers")

    assert found(tmp_path, "cluster", count_workers=fail).advice == "tcp://x:1: nobody answers"
    assert not found(tmp_path, "cluster", count_workers=lambda: 0).fit
    assert found(tmp_path, "cluster", count_workers=lambda: 2).fit


def test_the_command_says_what_is_not_fit_by_its_exit_code(
    run_command: RunCommand, tmp_path: Path
) -> None:
    done = run_command("doctor", "--json")
    assert done.exit_code == 0, done.stderr
    subjects = {one["subject"]: one for one in done.json["examined"]}
    assert subjects["extra compiled"]["found"] == "installed"
    assert all(one["fit"] for one in subjects.values())
    file = tmp_path / "no-folder"
    file.write_text("")
    done = run_command("doctor", root=file)
    assert done.exit_code == 10
    assert f"- data root {file}: " in done.stderr
    assert "not fit" in done.stdout
