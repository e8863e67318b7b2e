"""The program `fleet-slip`. It looks whether it can run here before anything large is imported."""

import signal
import sys

from fleet_slip.cli.early_exit import leave, tell
from fleet_slip.errors import FleetSlipError, StorageError, is_lack_of_memory
from fleet_slip.limits import memory_bytes, require_limits


def main() -> None:
    """Run the command line, and end with its exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave)
    try:
        require_limits()
        from fleet_slip.cli.app import run_app  # noqa: PLC0415 - see above
    except FleetSlipError as error:
        tell(f"error: {error}")
        sys.exit(error.exit_code)
    except (ImportError, OSError, MemoryError) as error:
        if not is_lack_of_memory(error):
            raise
        allowed = f"this process may have {memory_bytes() // 2**20:,} MiB for data"
        tell(f"error: out of memory before anything was done: {allowed}. Give it more.")
        sys.exit(StorageError.exit_code)
    sys.exit(run_app())
