"""The command line, in this process or in one of its own, none of which lasts for ever."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from unittest.mock import patch

from fleet_slip.cli.main import main as fleet_slip_main
from fleet_slip.storage.runs import LOGGER
from tests.support.once import require_no_failed_run

COMMAND = str(Path(sys.executable).with_name("fleet-slip"))
PATIENCE_S = 400.0
"""How long a process may take: many times what any takes, so that a busy machine fails no test."""

Words = Sequence[str | Path]


@dataclass(frozen=True)
class Finished:
    """A process that has ended."""

    exit_code: int
    stdout: str
    stderr: str

    @property
    def json(self) -> Any:
        return json.loads(self.stdout)


RunCommand = Callable[..., Finished]


def run(words: Words, *, patience_s: float = PATIENCE_S, **options: Any) -> Finished:
    """Run a program to its end; `TimeoutExpired` if it has none."""
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, timeout=patience_s, **options
    )
    return Finished(done.returncode, done.stdout, done.stderr)


def run_here(
    words: Sequence[str],
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
    input: str = "",  # noqa: A002 - as `subprocess` calls it
) -> Finished:
    """Run `fleet-slip` in this process, which is left as it was: a third of what another costs.

    What is no error of ours is raised, and ends no process.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with (
            _left_as_it_was(),
            contextlib.chdir(cwd or "."),
            tempfile.TemporaryFile("w+") as stdin,
        ):
            stdin.write(input)
            stdin.seek(0)
            if env is not None:
                os.environ.clear()
                os.environ.update(env)
            for descriptor, stream in enumerate((stdin, out, err)):
                os.dup2(stream.fileno(), descriptor)
            sys.argv = list(words)
            assert sys.__stdout__ and sys.__stderr__
            sys.stdin, sys.stdout, sys.stderr = stdin, sys.__stdout__, sys.__stderr__
            code = 0
            try:
                fleet_slip_main()
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
            sys.stdout.flush()
            sys.stderr.flush()
        return Finished(code, _text(out), _text(err))


_running_here = threading.Lock()


@contextlib.contextmanager
def _left_as_it_was() -> Iterator[None]:
    """Put back what a command changes of its process: streams, words, log, environment, limits."""
    descriptors = [os.dup(descriptor) for descriptor in range(3)]
    log = (LOGGER.handlers[:], LOGGER.level, LOGGER.propagate)
    limits = resource.getrlimit(resource.RLIMIT_DATA)
    streams: Any = {
        "stdin": sys.stdin,
        "stdout": sys.stdout,
        "stderr": sys.stderr,
        "argv": sys.argv,
    }
    with _running_here, patch.dict(os.environ), patch.multiple(sys, **streams):
        try:
            yield
        finally:
            for descriptor, copy in enumerate(descriptors):
                os.dup2(copy, descriptor)
                os.close(copy)
            LOGGER.handlers[:], LOGGER.level, LOGGER.propagate = log
            resource.setrlimit(resource.RLIMIT_DATA, limits)


def _can_run_here() -> bool:
    """Return True if no other thread uses, or may take, the streams of this process."""
    return threading.current_thread() is threading.main_thread() and not _running_here.locked()


def _text(file: IO[bytes]) -> str:
    """Return what a file holds, its ends of lines read as `subprocess` reads them."""
    file.seek(0)
    return file.read().decode().replace("\r\n", "\n").replace("\r", "\n")


def run_on(root: object, *arguments: str | Path, **options: Any) -> Finished:
    """Run `fleet-slip --root ROOT ...`, which never shows a traceback.

    In this process, unless options are given that only another can have.
    """
    words = [COMMAND, "--root", str(root), *map(str, arguments)]
    preloaded = "LD_PRELOAD" in (options.get("env") or {})  # read when a process begins
    in_process = options.keys() <= {"cwd", "env", "input"} and not preloaded and _can_run_here()
    done = (run_here if in_process else run)(words, **options)
    assert "Traceback" not in done.stderr, done.stderr
    require_no_failed_run(root)
    return done


def done_on(root: object, *arguments: str | Path, **options: Any) -> Finished:
    """Run `fleet-slip --root ROOT ...`, which must succeed."""
    done = run_on(root, *arguments, **options)
    assert done.exit_code == 0, done.stderr
    return done


def start(words: Words, **options: Any) -> subprocess.Popen[str]:
    """Start a program whose stdout and stderr are kept for `finish`."""
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, **options)


def start_on(root: object, *arguments: str | Path, **options: Any) -> subprocess.Popen[str]:
    """Start `fleet-slip --root ROOT ...`."""
    return start([COMMAND, "--root", str(root), *arguments], **options)


def finish(*processes: subprocess.Popen[str]) -> list[Finished]:
    """Wait for processes that run at once; if one has no end, kill them all."""
    try:
        outputs = [process.communicate(timeout=PATIENCE_S) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [
        Finished(process.returncode, stdout, stderr)
        for process, (stdout, stderr) in zip(processes, outputs, strict=True)
    ]


def until(condition: Callable[[], object], seconds: float = PATIENCE_S) -> None:
    """Wait until the condition holds; an `AssertionError` if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds:.0f} s in vain"
        time.sleep(0.02)


class LateError(BaseException):
    """Something hangs; not an `Exception`, which what hangs may catch."""


@contextmanager
def within(seconds: int = int(PATIENCE_S)) -> Iterator[None]:
    """Raise `LateError` in what hangs; of the main thread."""

    def stop(*_: Any) -> None:
        raise LateError(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
