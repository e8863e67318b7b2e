"""A campaign simulated across two network namespaces, as across two machines.

    sudo python -m benchmarks.cluster_namespaces

The scheduler and the command are in one namespace and the only worker in another; a pair of virtual
Ethernet interfaces joins them, and the data root is shared. Needs `ip` (iproute2) and the right to
make namespaces. The data files must be those of a run on this machine.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.cluster import data_files
from tests.support.dask_processes import DaskProcesses

COMMAND = str(Path(sys.executable).with_name("fleet-slip"))
NEAR, FAR = "fleet-slip-near", "fleet-slip-far"
NEAR_ADDRESS, FAR_ADDRESS = "10.199.7.1", "10.199.7.2"
SIMULATE = ("simulate", "smoke", "--json")


def run(*command: str) -> str:
    """Run a command and return what it prints."""
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def inside(namespace: str) -> tuple[str, ...]:
    """Return what stands before a command to run it in a namespace."""
    return ("ip", "netns", "exec", namespace)


@contextmanager
def two_namespaces() -> Iterator[None]:
    """Make two namespaces that are joined by a cable."""
    try:
        for namespace in (NEAR, FAR):
            run("ip", "netns", "add", namespace)
        peer = ("peer", "name", "cable", "netns", FAR)
        run("ip", "link", "add", "cable", "netns", NEAR, "type", "veth", *peer)
        for namespace, address in ((NEAR, NEAR_ADDRESS), (FAR, FAR_ADDRESS)):
            run("ip", "-n", namespace, "address", "add", f"{address}/24", "dev", "cable")
            run("ip", "-n", namespace, "link", "set", "cable", "up")
            run("ip", "-n", namespace, "link", "set", "lo", "up")
        yield
    finally:
        for namespace in (NEAR, FAR):
            subprocess.run(["ip", "netns", "delete", namespace], check=False)


def main() -> None:
    """Simulate on this machine and across the namespaces, and compare."""
    if os.geteuid() != 0:
        sys.exit("making network namespaces takes root")
    with tempfile.TemporaryDirectory() as name, two_namespaces():
        here, there = Path(name) / "here", Path(name) / "there"
        run(COMMAND, "--root", str(here), *SIMULATE)
        dask = DaskProcesses(Path(name), NEAR_ADDRESS)
        try:
            dask.start_scheduler(*inside(NEAR))
            dask.start_worker(before=inside(FAR))
            start = time.perf_counter()
            command = [COMMAND, "--root", str(there), *SIMULATE, "--cluster", dask.address]
            run(*inside(NEAR), *command)
            seconds = time.perf_counter() - start
            command[command.index("simulate") : command.index("--json")] = ["gram"]
            run(*inside(NEAR), *command)
        finally:
            dask.close()
        run(COMMAND, "--root", str(here), "gram")
        assert data_files(here) == data_files(there), "the bits differ"
        print(
            f"{len(data_files(there))} files across two namespaces, the same bits; {seconds:.1f} s"
        )


if __name__ == "__main__":
    main()
