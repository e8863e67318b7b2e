"""Memory limits of this process."""

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUP = Path("/proc/self/cgroup")

LIBRARIES_BYTES = 7 * 2**29
"""Address space that the libraries reserve; they use little of it."""
THREAD_BYTES = 2**28
"""Address space per processor: stacks and heaps of the libraries' threads."""
DATA_BYTES = 2**30
"""Private memory, as `ulimit -d` counts it, that the libraries need to start and end."""
DATA_THREAD_BYTES = 2**26
"""Private memory per processor that the libraries need."""


def memory_bytes() -> int:
    """Return the memory for data: the least of the machine's, the control group's and limits."""
    allowed = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_cgroup_limits()]
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY:
        allowed.append(max(address_space - LIBRARIES_BYTES, THREAD_BYTES))
    _, data = resource.getrlimit(resource.RLIMIT_DATA)  # the soft limit may be our own
    if data != resource.RLIM_INFINITY:
        allowed.append(max(data - DATA_BYTES // 2, THREAD_BYTES))
    return min(allowed)


def data_needed() -> int:
    """Return the smallest `ulimit -d` under which the libraries work."""
    return DATA_BYTES + DATA_THREAD_BYTES * len(os.sched_getaffinity(0))


def _cgroup_limits() -> Iterator[int]:
    """Yield the memory limits of this process's control group (version 2) and its parents.

    In a container the path may be the host's, and the limit at the top.
    """
    with contextlib.suppress(OSError):
        path = OWN_CGROUP.read_text(encoding="utf-8").strip().rpartition("::")[2]
        group = CGROUPS / path.lstrip("/")
        for folder in (group, *group.parents):
            with contextlib.suppress(OSError, ValueError):
                yield int((folder / "memory.max").read_text(encoding="ascii"))
