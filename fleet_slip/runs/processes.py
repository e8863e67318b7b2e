"""Tells a process from a later one of the same number."""

from pathlib import Path

PROC = Path("/proc")
START = 19
"""Place of the start among the fields behind the name, proc(5): ticks since the machine booted."""


def process_began(number: int) -> str | None:
    """Return the boot and the start of a process of this machine; None if it is not known.

    The system gives the number of a process that is gone to another one. Neither the boot nor the
    ticks since it depend on the clock.
    """
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        status = (PROC / str(number) / "stat").read_bytes()
    except OSError:
        return None
    return f"{boot}/{status.rpartition(b')')[2].split()[START].decode()}"
