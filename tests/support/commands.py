"""The command line in processes of their own, none of which lasts for ever."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from tests.support.once import require_no_failed_run
from tests.support.prepared import server, without_test

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


def run_prepared(
    words: Sequence[str], cwd: str | Path | None = None, env: Mapping[str, str] | None = None
) -> Finished:
    """Run `fleet-slip` as `run` does, in a process that has imported it already if that can be."""
    environment = without_test(os.environ if env is None else env)
    prepared = server()
    if not prepared.can_run_in(environment):
        return run(words, cwd=cwd, env=env)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        streams = (out.fileno(), err.fileno())
        code = prepared.run(list(words), Path(cwd or "."), environment, streams, PATIENCE_S)
        return Finished(code, _text(out), _text(err))


def _text(file: IO[bytes]) -> str:
    """Return what a file holds, its ends of lines read as `subprocess` reads them."""
    file.seek(0)
    return file.read().decode().replace("\r\n", "\n").replace("\r", "\n")


def run_on(root: object, *arguments: str | Path, **options: Any) -> Finished:
    """Run `fleet-slip --root ROOT ...`, which never shows a traceback."""
    words = [COMMAND, "--root", str(root), *map(str, arguments)]
    prepared = options.keys() <= {"cwd", "env"}
    done = run_prepared(words, **options) if prepared else run(words, **options)
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
        told = [process.communicate(timeout=PATIENCE_S) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [
        Finished(process.returncode, stdout, stderr)
        for process, (stdout, stderr) in zip(processes, told, strict=True)
    ]
