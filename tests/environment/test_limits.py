"""Limits that a shell or a control group sets."""

import os
import resource
import shlex
from pathlib import Path

import pytest

from fleet_slip import resources
from fleet_slip.errors import StorageError
from tests.support.commands import COMMAND, Finished, run

pytestmark = pytest.mark.long

ENOUGH_KIB = (
    resources.LIBRARIES_BYTES + resources.THREAD_BYTES * len(os.sched_getaffinity(0))
) // 2**10


ENOUGH_DATA_KIB = resources.data_needed() // 2**10


@pytest.mark.parametrize(
    "limit",
    [
        *(f"-v {ENOUGH_KIB}", f"-d {ENOUGH_DATA_KIB}", "-n 64"),
        f"-d {ENOUGH_DATA_KIB + 150_000}",  # what Arrow would take for itself, and too little more
    ],
)
def test_the_documented_limits_are_sufficient(tmp_path: Path, limit: str) -> None:
    root = tmp_path / "data"
    done = run(
        ["bash", "-c", f"ulimit {limit} && {COMMAND} --root {root} run --campaign smoke --days 1"]
    )
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "data/models/smoke/versions/1.json").exists()


@pytest.mark.parametrize(
    "limit", [f"-v {ENOUGH_KIB - 1}", f"-d {ENOUGH_DATA_KIB - 1}", "-d 600000"]
)
def test_a_limit_under_which_libraries_abort_is_refused(tmp_path: Path, limit: str) -> None:
    done = run(["bash", "-c", f"ulimit {limit} && {COMMAND} --root {tmp_path / 'data'} status"])
    assert done.exit_code == StorageError.exit_code
    assert done.stderr.startswith(f"error: ulimit {limit[:2]} is")
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("membership", "file"),
    [
        ("0::/system.slice/fleet-slip.service", "system.slice/fleet-slip.service/memory.max"),
        ("0::/system.slice/fleet-slip.service", "system.slice/memory.max"),
        ("0::/of/the/host", "memory.max"),
    ],
)
def test_the_limit_of_a_control_group_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, membership: str, file: str
) -> None:
    """The limit comes from systemd's MemoryMax= or from a container."""
    (tmp_path / "cgroup").write_text(membership + "\n")
    (tmp_path / "fs" / file).parent.mkdir(parents=True)
    (tmp_path / "fs" / file).write_text("123456789\n")
    (tmp_path / "fs/memory.max").touch()
    monkeypatch.setattr(resources, "CGROUPS", tmp_path / "fs")
    monkeypatch.setattr(resources, "OWN_CGROUP", tmp_path / "cgroup")
    assert resources.memory_bytes() == 123456789


@pytest.mark.parametrize(
    ("address_space", "data", "remaining"),
    [
        (resources.LIBRARIES_BYTES + 10**9, resource.RLIM_INFINITY, 10**9),
        (resource.RLIM_INFINITY, 2 * 10**9, 2 * 10**9 - resources.DATA_BYTES // 2),
    ],
)
def test_data_gets_what_the_libraries_leave(
    monkeypatch: pytest.MonkeyPatch, address_space: int, data: int, remaining: int
) -> None:
    hard = {resource.RLIMIT_AS: address_space, resource.RLIMIT_DATA: data}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (hard[kind], hard[kind]))
    assert resources.memory_bytes() == remaining


FULL = Path("/dev/full")
STORAGE = StorageError.exit_code

needs_a_full_device = pytest.mark.skipif(not FULL.exists(), reason="no /dev/full on this system")


def run_in_shell(root: Path, arguments: str, redirection: str) -> Finished:
    """Run the command with bash's redirection; its own exit code, not that of the pipe's end."""
    command = f"{shlex.quote(COMMAND)} --root {shlex.quote(str(root))} {arguments} {redirection}"
    done = run(["bash", "-c", f"{command}; exit ${{PIPESTATUS[0]}}"])
    assert "Traceback" not in done.stderr + done.stdout, done
    assert "Exception ignored" not in done.stderr, done
    return done


@pytest.mark.parametrize(
    ("redirection", "exit_code"),
    [
        pytest.param(">/dev/full", STORAGE, marks=needs_a_full_device),
        (">&-", STORAGE),
        ("2>&-", 0),
        pytest.param("2>/dev/full", 0, marks=needs_a_full_device),
        ("| head -0", 0),
        ("2>&1 | head -0", 0),
    ],
)
def test_a_job_is_done_whatever_its_streams_are(
    smoke_copy: Path, redirection: str, exit_code: int
) -> None:
    done = run_in_shell(smoke_copy, "publish other --models table1", redirection)
    assert done.exit_code == exit_code
    assert (smoke_copy / "models/other/versions/1.json").exists()
    if exit_code:
        assert "error: standard output:" in done.stderr


@needs_a_full_device
@pytest.mark.parametrize(
    "arguments", ["models --json", "sql 'SELECT 1' --csv", "sql 'SELECT 1'", "--help", "--version"]
)
def test_an_answer_that_cannot_be_printed_is_no_success(tmp_path: Path, arguments: str) -> None:
    done = run_in_shell(tmp_path, arguments, ">/dev/full")
    assert done.exit_code == STORAGE
    assert done.stderr.count("No space left on device") == 1


def test_wrong_usage_keeps_its_exit_code_without_streams(tmp_path: Path) -> None:
    assert run_in_shell(tmp_path, "no-such-command", "2>&-").exit_code == 2
    assert run_in_shell(tmp_path, "sql -", "<&- 2>&1").exit_code == 5


def test_a_reader_that_has_enough_is_no_failure(tmp_path: Path) -> None:
    done = run_in_shell(tmp_path, "sql 'FROM range(200000)' --csv", "| head -2")
    assert (done.exit_code, done.stdout.splitlines(), done.stderr) == (0, ['"range"', "0"], "")


def test_a_closed_stream_is_not_taken_by_a_data_file(tmp_path: Path) -> None:
    """The first file that a process opens gets the number of a stream that is closed."""
    code = (
        "import os, sys; from fleet_slip.cli.output import Streams; Streams(); "
        "data = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT); assert data > 2, data; "
        "print('result', flush=True); print('remark', file=sys.stderr, flush=True)"
    )
    python = shlex.quote(str(Path(COMMAND).with_name("python")))
    file = tmp_path / "data"
    command = f"{python} -c {shlex.quote(code)} {shlex.quote(str(file))} <&- >&- 2>&-"
    assert run(["bash", "-c", command]).exit_code == 0
    assert file.read_bytes() == b""
