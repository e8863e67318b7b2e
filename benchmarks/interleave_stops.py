"""A command that stops at a point, where another one runs whole, and then goes on or dies.

A point is just before a call that changes what others see, or takes a look at what they changed.
What two points have between them is seen by no other process, so that no more stops are needed.
"""

import os
import select
import signal
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import obstore
from deltalake import DeltaTable
from deltalake.table import TableAlterer

from benchmarks.harness import call, in_child
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.objects import ObjectFolder
from fleet_slip.storage.table import Table

POINTS: tuple[tuple[Any, str], ...] = (
    (Path, "replace"),
    (Path, "rename"),
    (Path, "unlink"),
    (Path, "hardlink_to"),
    (obstore, "put"),
    (obstore, "delete"),
    (DeltaTable, "create"),
    (DeltaTable, "create_write_transaction"),
    (DeltaTable, "create_checkpoint"),
    (TableAlterer, "add_columns"),
    (TableAlterer, "set_column_metadata"),
    (TableAlterer, "set_table_properties"),
    (Table, "open_delta"),
    (LocalFolder, "files"),
    (ObjectFolder, "files"),
)
HANGS_S = 120.0
"""A command that says nothing for so long hangs."""

Environment = Mapping[str, str]


@dataclass(frozen=True)
class Outcome:
    """How a command ended: its exit code, None if it was killed, and what it said."""

    exit_code: int | None
    output: str
    points: int = 0


class _Gate:
    """Counts the points of this process. At one it tells the parent, waits, and does as told."""

    def __init__(self, stop_at: int, die_before: str, tell: int, reply: int) -> None:
        self._stop_at, self._die_before, self._tell, self._reply = stop_at, die_before, tell, reply
        self._fatal = 0
        self._one_at_a_time = threading.Lock()  # all threads stop together
        self.passed = 0

    def point(self, name: str) -> None:
        with self._one_at_a_time:
            self.passed += 1
            if self.passed == self._stop_at:
                os.write(self._tell, b"s")
                after = int(os.read(self._reply, 8) or b"0")
                self._fatal = self.passed + after if after >= 0 else 0
            if self.passed == self._fatal or name == self._die_before:
                os.kill(os.getpid(), signal.SIGKILL)

    def before(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            self.point(name)
            return function(*arguments, **options)

        return wrapped


class Running:
    """A command in a process of its own."""

    def __init__(
        self,
        root: object,
        arguments: tuple[str, ...],
        environment: Environment,
        stop_at: int = 0,
        die_before: str = "",
    ) -> None:
        """Start it. It stops at a point, if there are as many, or dies before a call."""
        self._folder = tempfile.TemporaryDirectory(prefix="interleave-")
        self._answer, self._noise = (Path(self._folder.name) / name for name in ("a", "n"))
        self._reply, tell = os.pipe()
        listen, self._tell = os.pipe()
        self._process = os.fork()
        if not self._process:
            os.close(self._reply)
            os.close(self._tell)
            gate = _Gate(stop_at, die_before, tell, listen)
            in_child(lambda: _give(root, arguments, environment, gate), self._answer, self._noise)
        os.close(tell)
        os.close(listen)

    def stopped(self) -> bool:
        """Wait until it stops, and return True; or ends, and return False."""
        if not select.select([self._reply], [], [], HANGS_S)[0]:
            self._kill()
            return False
        return os.read(self._reply, 1) == b"s"

    def go_on(self, die_after: int | None = None) -> None:
        """Let it go on; or die, so many points later."""
        os.write(self._tell, str(-1 if die_after is None else die_after).encode())

    def end(self) -> Outcome:
        """Wait for the end."""
        if not select.select([self._reply], [], [], HANGS_S)[0]:
            self._kill()
        status = os.waitpid(self._process, 0)[1]
        os.close(self._reply)
        os.close(self._tell)
        output = self._noise.read_text() if self._noise.exists() else ""
        answer = self._answer.read_text() if self._answer.exists() else ""
        self._folder.cleanup()
        if os.WIFSIGNALED(status):
            return Outcome(None, output)
        if os.WEXITSTATUS(status):
            return Outcome(1, output)
        code, points = map(int, answer.strip("[]").split(","))
        return Outcome(code, output, points)

    def _kill(self) -> None:
        os.kill(self._process, signal.SIGKILL)


def command(root: object, arguments: tuple[str, ...], environment: Environment) -> int:
    """Run one command in this process; return its exit code."""
    use(environment)
    return call(root, arguments)


def use(environment: Environment) -> None:
    """Let the commands of this process have an environment."""
    os.environ.update(environment)


def _give(
    root: object, arguments: tuple[str, ...], environment: Environment, gate: _Gate
) -> list[int]:
    for owner, name in POINTS:
        setattr(owner, name, gate.before(name, getattr(owner, name)))
    return [command(root, arguments, environment), gate.passed]
