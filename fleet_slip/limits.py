"""What this process may have of the system, and the least that it needs."""

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path

from fleet_slip.errors import StorageError

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUP = Path("/proc/self/cgroup")

LIBRARIES_BYTES = 3 * 2**30
"""Address space that the libraries reserve, nearly all of it never used."""
THREAD_BYTES = 2**28
"""The same for each processor: stacks and heaps of the threads that the libraries start."""
DATA_BYTES = 2**30
"""Memory of its own, as `ulimit -d` counts it, that the libraries need to start and to end well."""
DATA_THREAD_BYTES = 2**26
"""The same for each processor."""
OPEN_FILES = 64


def memory_bytes() -> int:
    """Return the memory for data: the machine's, or less in a control group or under a limit."""
    allowed = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_cgroup_limits()]
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY:
        allowed.append(max(address_space - LIBRARIES_BYTES, THREAD_BYTES))
    _, data = resource.getrlimit(resource.RLIMIT_DATA)  # the soft one may be our own
    if data != resource.RLIM_INFINITY:
        allowed.append(max(data - DATA_BYTES // 2, THREAD_BYTES))
    return min(allowed)


def data_needed() -> int:
    """Return the least limit of data (`ulimit -d`) that the libraries survive."""
    return DATA_BYTES + DATA_THREAD_BYTES * len(os.sched_getaffinity(0))


def require_limits() -> None:
    """Raise `StorageError` under limits of the shell that libraries do not survive."""
    address_space = LIBRARIES_BYTES + THREAD_BYTES * len(os.sched_getaffinity(0))
    unused, silent = "most of it reserved and never used", "or its libraries end it without a word"
    for kind, flag, needed, what, why in (
        (resource.RLIMIT_AS, "-v", address_space, "address space", unused),
        (resource.RLIMIT_DATA, "-d", data_needed(), "data", silent),
    ):
        allowed, _ = resource.getrlimit(kind)
        if allowed != resource.RLIM_INFINITY and allowed < needed:
            raise StorageError(
                f"this process may have {allowed // 2**20:,} MiB of {what} and needs "
                f"{needed // 2**20:,} MiB, {why}. Raise the limit: ulimit {flag} "
                f"{needed // 2**10}. To limit memory itself use a control group, such as "
                "systemd's MemoryMax=."
            )
    data, _ = resource.getrlimit(resource.RLIMIT_DATA)
    if data != resource.RLIM_INFINITY:
        # Else Arrow's allocator takes a GiB of it before anybody asks, and leaves none to others.
        os.environ.setdefault("MIMALLOC_ARENA_EAGER_COMMIT", "0")
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and files < OPEN_FILES:
        raise StorageError(
            f"this process may have {files} files open and needs {OPEN_FILES}. Raise the limit: "
            "ulimit -n 1024"
        )


def _cgroup_limits() -> Iterator[int]:
    """Yield the limits of memory of this process's control group and of those above it."""
    with contextlib.suppress(OSError):
        for line in OWN_CGROUP.read_text(encoding="utf-8").splitlines():
            _, kinds, path = line.split(":", 2)
            if kinds and "memory" not in kinds.split(","):
                continue
            # In a container the path may be the host's, and the limit at the top.
            top, name = (
                (CGROUPS / "memory", "memory.limit_in_bytes") if kinds else (CGROUPS, "memory.max")
            )
            group = top / path.lstrip("/")
            for folder in (group, *group.parents):
                with contextlib.suppress(OSError, ValueError):
                    yield int((folder / name).read_text(encoding="ascii"))
                if folder == top:
                    break
