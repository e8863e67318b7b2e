"""Limits that a shell or a control group sets."""

import os
import resource
from pathlib import Path

import pytest

from fleet_slip import limits
from tests.support.commands import COMMAND, run

pytestmark = pytest.mark.long

ENOUGH_KIB = (limits.LIBRARIES_BYTES + limits.THREAD_BYTES * len(os.sched_getaffinity(0))) // 2**10


ENOUGH_DATA_KIB = limits.data_needed() // 2**10


@pytest.mark.parametrize(
    "limit",
    [
        *(f"-v {ENOUGH_KIB}", f"-d {ENOUGH_DATA_KIB}", "-n 64"),
        f"-d {ENOUGH_DATA_KIB + 150_000}",  # what Arrow would take for itself, and too little more
    ],
)
def test_what_is_said_to_be_enough_is_enough(tmp_path: Path, limit: str) -> None:
    root = tmp_path / "data"
    done = run(
        ["bash", "-c", f"ulimit {limit} && {COMMAND} --root {root} run --campaign smoke --days 1"]
    )
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "data/models/smoke/versions/1.json").exists()


@pytest.mark.parametrize(
    ("membership", "file"),
    [
        ("0::/system.slice/fleet-slip.service", "system.slice/fleet-slip.service/memory.max"),
        ("0::/system.slice/fleet-slip.service", "system.slice/memory.max"),
        ("0::/of/the/host", "memory.max"),
        ("7:cpu:/\n5:memory,hugetlb:/docker/1", "memory/docker/1/memory.limit_in_bytes"),
        ("5:memory:/docker/1", "memory/memory.limit_in_bytes"),
    ],
)
def test_the_limit_of_a_control_group_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, membership: str, file: str
) -> None:
    """Of systemd's MemoryMax= and of a container, in both versions of control groups."""
    (tmp_path / "cgroup").write_text(membership + "\n")
    (tmp_path / "fs" / file).parent.mkdir(parents=True)
    (tmp_path / "fs" / file).write_text("123456789\n")
    (tmp_path / "fs/memory.max").touch()
    monkeypatch.setattr(limits, "CGROUPS", tmp_path / "fs")
    monkeypatch.setattr(limits, "OWN_CGROUP", tmp_path / "cgroup")
    assert limits.memory_bytes() == 123456789


def test_data_gets_what_the_libraries_leave_of_the_address_space(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    allowed = limits.LIBRARIES_BYTES + 10**9
    unlimited = resource.RLIM_INFINITY
    monkeypatch.setattr(
        resource,
        "getrlimit",
        lambda kind: (allowed if kind == resource.RLIMIT_AS else unlimited,) * 2,
    )
    assert limits.memory_bytes() == 10**9


def test_data_gets_what_the_libraries_leave_of_a_limit_of_data(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hard = {resource.RLIMIT_AS: resource.RLIM_INFINITY, resource.RLIMIT_DATA: 2 * 10**9}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (hard[kind], hard[kind]))
    assert limits.memory_bytes() == 2 * 10**9 - limits.DATA_BYTES // 2
