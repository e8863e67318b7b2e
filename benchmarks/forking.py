"""Work in forked processes: what has been imported once is there in each of them."""

import json
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Ended:
    """A forked process that is over."""

    killed: bool
    result: Any
    seconds: float


def forked(work: Callable[[], Any], kill_after_s: float | None = None) -> Ended:
    """Do work in a forked process and return its result, or kill it after a time."""
    with tempfile.TemporaryDirectory() as folder:
        answer, noise = Path(folder) / "answer", Path(folder) / "noise"
        started = time.monotonic()
        process = os.fork()
        if not process:
            in_child(work, answer, noise)
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            os.kill(process, signal.SIGKILL)
        status = os.waitpid(process, 0)[1]
        seconds = time.monotonic() - started
        if os.WIFSIGNALED(status):
            return Ended(True, None, seconds)
        if os.WEXITSTATUS(status):
            raise AssertionError(noise.read_text())
        return Ended(False, json.loads(answer.read_text()), seconds)


def in_child(work: Callable[[], Any], answer: Path, noise: Path) -> None:
    """Do work in this process, write its result and what it says to files, and end."""
    code = 1
    try:
        with noise.open("w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            answer.write_text(json.dumps(work()))
            code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)
