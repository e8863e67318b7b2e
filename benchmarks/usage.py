"""Runs a command in a process of its own and tells what that process took.

The kernel counts the memory of whoever started a process as the process's own until it has begun.
So the command is started by this module run as a small program, which holds next to nothing.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Usage:
    """The resources that a process used.

    Attributes:
        seconds: from its start to its end, interpreter and imports included.
        cpu_s: time on processors, of all its threads.
        peak_bytes: largest resident memory, of all its threads.
        output: what it wrote on stdout.
    """

    seconds: float
    cpu_s: float
    peak_bytes: int
    output: str


def measured(command: Sequence[str], answers: Collection[int] = (0,)) -> Usage:
    """Run a command to its end.

    Raises `RuntimeError` with what it said if its exit code is not among the answers.
    """
    with tempfile.NamedTemporaryFile() as answer:
        launcher = [sys.executable, "-I", "-S", __file__, answer.name, *command]
        done = subprocess.run(launcher, capture_output=True, text=True, check=False)
        if done.returncode not in answers:
            raise RuntimeError(f"{' '.join(command)} failed: {done.stderr.strip()[-2000:]}")
        return Usage(**json.loads(Path(answer.name).read_text("ascii")), output=done.stdout)


def _launch(answer: str, command: Sequence[str]) -> int:
    started = time.monotonic()
    process = os.posix_spawnp(command[0], list(command), os.environ)
    _, status, usage = os.wait4(process, 0)
    result = {
        "seconds": time.monotonic() - started,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "peak_bytes": usage.ru_maxrss * 1024,
    }
    Path(answer).write_text(json.dumps(result), encoding="ascii")
    return os.waitstatus_to_exitcode(status)


if __name__ == "__main__":
    sys.exit(abs(_launch(sys.argv[1], sys.argv[2:])))
