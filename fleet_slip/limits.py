"""What this process may have of the system."""

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUP = Path("/proc/self/cgroup")

LIBRARIES_BYTES = 7 * 2**29
"""Address space that the libraries reserve, nearly all of it never used."""
THREAD_BYTES = 2**28
"""The same for each processor: stacks and heaps of the threads that the libraries start."""
DATA_BYTES = 2**30
"""Memory of its own, as `ulimit -d` counts it, that the libraries need to start and to end well."""
DATA_THREAD_BYTES = 2**26
"""The same for each processor."""


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


def spare_data() -> None:
    """Keep Arrow's allocator from taking a GiB of what this process may have, before it is asked.

    To be called before Arrow is imported.
    """
    if resource.getrlimit(resource.RLIMIT_DATA)[0] != resource.RLIM_INFINITY:
        os.environ.setdefault("MIMALLOC_ARENA_EAGER_COMMIT", "0")


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
