"""The command line in processes that need not import the program: it is half of what they cost.

A server that has imported everything forks for each command. The process has arguments, folder,
environment and streams of its own, ends as one that was started anew, and can be killed. Variables
that may be read while importing must be those of the server.
"""

import atexit
import contextlib
import gc
import importlib
import json
import os
import pkgutil
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Never

import fleet_slip
from fleet_slip.cli.main import main as fleet_slip_main
from fleet_slip.ingest.columns import conversion_factor

READ_LATE = (
    *("AWS_", "FLEET_SLIP_", "XDG_CACHE_HOME", "CACHE_DIRECTORY", "TMPDIR"),
    *("_FLEET_SLIP_COMPLETE", "COMP_"),
    *("KMP_", "PYGAME_"),  # scikit-learn and highway-env set them where they are imported
)
"""How variables begin that nothing of the program reads while importing."""

LATE = ("pandas", "matplotlib.figure")
"""What libraries import at their first use."""


@dataclass(frozen=True)
class Server:
    """A running server: where it listens, which process, and what environment those of it have."""

    address: str
    process: int
    environment: dict[str, str]

    def can_run_in(self, wanted: Mapping[str, str]) -> bool:
        """Whether an environment differs in nothing that is read while importing."""
        both = {*self.environment.items(), *wanted.items()}
        shared = self.environment.items() & wanted.items()
        return all(name.startswith(READ_LATE) for name, _ in both - shared)

    def run(
        self,
        words: list[str],
        folder: Path,
        environment: Mapping[str, str],
        streams: tuple[int, int],
        patience_s: float,
    ) -> int:
        """Run a program's words in a folder, with two descriptors for what it says.

        Returns how it ended, negative if by a signal, as of `subprocess`. Who loses patience or is
        interrupted kills it.
        """
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(patience_s)
            connection.connect(self.address)
            given = {"words": words, "folder": str(folder), "environment": dict(environment)}
            asked = json.dumps(given).encode()
            socket.send_fds(connection, [len(asked).to_bytes(4, "big") + asked], list(streams))
            with connection.makefile("r") as answers:
                process = int(answers.readline())
                try:
                    return int(answers.readline())
                except BaseException:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(process, signal.SIGKILL)
                    raise


def without_test(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without the name of the test that runs."""
    return {name: value for name, value in environment.items() if name != "PYTEST_CURRENT_TEST"}


@cache
def server() -> Server:
    """Return this process's server, which ends when this process does."""
    folder = tempfile.mkdtemp(prefix="fleet-slip-tests-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    address = str(Path(folder) / "server")
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, address],
        cwd=Path(__file__).parents[2],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=without_test(os.environ),
    )
    assert process.stdout is not None
    assert process.stdout.readline(), "the server of prepared processes did not start"
    return Server(address, process.pid, without_test(os.environ))


def main(address: str) -> None:
    """Serve until stdin closes. What a forked process is to do is done at the end of the module."""
    for module in _modules():
        importlib.import_module(module)
    conversion_factor("km/h", "m/s")  # pint reads its definitions at the first use
    os.fsync = os.fstat  # type: ignore[assignment]  # as in tests/conftest.py
    gc.freeze()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen()
        _end_with_parent()
        ended, wake = os.pipe()
        os.set_blocking(wake, False)
        signal.set_wakeup_fd(wake)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        running: dict[int, socket.socket] = {}
        while True:
            ready, _, _ = select.select([listener.fileno(), ended], [], [])
            if ended in ready:
                os.read(ended, 1 << 12)
                _tell_ended(running)
            if listener.fileno() not in ready:
                continue
            connection, _ = listener.accept()
            asked, streams = _received(connection)
            process = os.fork()  # a hundredth of a second here, and one there
            if not process:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for descriptor in (ended, wake):
                    os.close(descriptor)
                for one in (listener, connection, *running.values()):
                    one.close()
                return _become(asked, streams)
            for stream in streams:
                os.close(stream)
            running[process] = connection
            connection.sendall(f"{process}\n".encode())


def _modules() -> Iterator[str]:
    """Yield the modules of the program, and what libraries import late."""
    for module in pkgutil.walk_packages(fleet_slip.__path__, "fleet_slip."):
        if not module.name.endswith("__main__"):
            yield module.name
    yield from LATE


def _end_with_parent() -> None:
    """Fork a process that waits for the end of stdin and then ends its parent."""
    parent = os.getpid()
    if not os.fork():
        os.read(0, 1)
        with contextlib.suppress(ProcessLookupError):
            os.kill(parent, signal.SIGKILL)
        os._exit(0)


def _received(connection: socket.socket) -> tuple[dict[str, Any], list[int]]:
    """Return what is asked, and the streams of the command."""
    begun, streams, *_ = socket.recv_fds(connection, 1 << 16, 2)
    size = int.from_bytes(begun[:4], "big")
    while len(begun) < 4 + size:
        begun += connection.recv(1 << 16)
    asked: dict[str, Any] = json.loads(begun[4:])
    return asked, streams


def _tell_ended(running: dict[int, socket.socket]) -> None:
    """Tell those who wait for commands that have ended how they did."""
    while True:
        process, status = os.waitpid(-1, os.WNOHANG)
        if not process:
            return
        with running.pop(process) as connection, contextlib.suppress(OSError):
            connection.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())


def _become(asked: dict[str, Any], streams: list[int]) -> None:
    """Take the streams, the folder and the words of a command."""
    with Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)
    for wanted, given in enumerate(streams, start=1):
        os.dup2(given, wanted)
        os.close(given)
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    tempfile.tempdir = None  # what TMPDIR said before
    sys.argv = asked["words"]
    sys.modules["__main__"].__package__ = None  # or messages would say `python -m`
    sys.path[0] = str(Path(sys.argv[0]).parent)


def _run_command() -> Never:
    """Run the command and end as the interpreter does, without taking every module apart."""
    code = 1
    try:
        fleet_slip_main()
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    main(sys.argv[1])
    _run_command()
