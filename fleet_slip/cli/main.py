"""The program `fleet-slip`: what it answers while nothing large has been imported."""

import contextlib
import gc
import os
import resource
import signal
import sys
from typing import Any

from fleet_slip.errors import INTERRUPTED, StorageError, is_lack_of_memory
from fleet_slip.resources import find_low_limit, memory_bytes


def _leave(_signal: int, _frame: Any) -> None:
    """End at once: what answers Ctrl-C while modules are imported, which not all survive."""
    _tell("interrupted: nothing was done yet.")
    os._exit(INTERRUPTED)


def main() -> None:
    """Run the command line, and end with its exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)
    if low_limit := find_low_limit():
        _tell(f"error: {low_limit}")
        sys.exit(StorageError.exit_code)
    try:
        _prepare_imports()
        from fleet_slip.cli.app import run_app
    except (ImportError, OSError, MemoryError) as error:
        if not is_lack_of_memory(error):
            raise
        allowed = f"this process may have {memory_bytes() // 2**20:,} MiB for data"
        _tell(f"error: out of memory before anything was done: {allowed}. Give it more.")
        sys.exit(StorageError.exit_code)
    sys.exit(run_app())


PANDAS_USERS = {"asammdf", "highway_env", "mlflow", "nptdms"}
"""Packages that need pandas."""


class _HiddenPandas:
    """Hides pandas from pyarrow, whose first array imports it: a quarter of a short command."""

    @staticmethod
    def find_spec(name: str, _path: Any = None, _target: Any = None) -> None:
        if name == "pandas" and PANDAS_USERS.isdisjoint(sys.modules):
            raise ModuleNotFoundError(name, name=name)


def _prepare_imports() -> None:
    """Hide pandas, and set the variables that libraries read when they are imported."""
    sys.meta_path.insert(0, _HiddenPandas())
    if resource.getrlimit(resource.RLIMIT_DATA)[0] != resource.RLIM_INFINITY:
        os.environ.setdefault("MIMALLOC_ARENA_EAGER_COMMIT", "0")  # 1 GiB that Arrow would reserve
    # Pydantic looks for plugins among all installed packages: 10 ms, and none is used.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Imports make many objects and hardly any garbage: one collection takes 15 ms.
    gc.set_threshold(max(100_000, gc.get_threshold()[0]))


def _tell(text: str) -> None:
    """Print a remark on stderr, by Python alone."""
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode())
