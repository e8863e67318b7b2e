"""Shared parts of benchmarks: sample rows, clocks, commands in forked processes, tables in pages.

A process that has imported everything forks for every command, which takes a tenth of the time.
"""

import argparse
import contextlib
import importlib
import json
import os
import pkgutil
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fleet_slip
from fleet_slip.cli.main import main as fleet_slip_main
from fleet_slip.grams.update import update_grams
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.simulate import simulate_campaign, simulate_logs
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS

# Rows


def add_options(parser: argparse.ArgumentParser) -> None:
    """Let the user say where the rows are, and whose they are."""
    parser.add_argument("--root", type=Path, help="default: a temporary folder")
    parser.add_argument("--campaign", default="waterford")


@contextlib.contextmanager
def simulated(options: argparse.Namespace) -> Iterator[Warehouse]:
    """Yield a warehouse with the campaign that `add_options` names, its Gram rows up to date."""
    with tempfile.TemporaryDirectory() as folder:
        warehouse = Warehouse(LocalFolder(options.root or Path(folder) / "data"))
        campaign = load_campaign(options.campaign, SHIPPED_CONFIGS)
        with ThreadPoolExecutor(2) as executor:
            simulate_campaign(warehouse, campaign, campaign.days(), executor)
        update_grams(warehouse)
        logs = warehouse.logs.snapshot()
        print(
            f"{logs.rows:,} rows in {len(logs.files)} files: {logs.size_bytes / logs.rows:.2f} "
            "bytes a row, all columns included\n"
        )
        yield warehouse


@contextlib.contextmanager
def quick_folder() -> Iterator[Path]:
    """Yield a temporary folder, in memory if there is one: then nothing waits for a disk."""
    memory = Path("/dev/shm")  # noqa: S108
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


# Time and memory


def durations(
    function: Callable[[], object], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Return how long each of some calls takes, in s."""
    results = []
    for _ in range(rounds):
        start = clock()
        function()
        results.append(clock() - start)
    return results


def peak_bytes(process: int | str = "self") -> int:
    """Return the most memory that a process has held, resident."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


# Forked processes


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


def call(root: object, arguments: tuple[str, ...]) -> int:
    """Run one command in this process; return its exit code."""
    sys.argv = ["fleet-slip", "--root", str(root), *arguments]
    try:
        fleet_slip_main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def load_code(campaign: str) -> None:
    """Load in this process what commands load when they are called, so that its forks need not."""
    for module in pkgutil.walk_packages(fleet_slip.__path__, "fleet_slip."):
        with contextlib.suppress(ImportError):  # an extra that is not there
            importlib.import_module(module.name)
    for name in ("pandas", "pyarrow.dataset"):
        importlib.import_module(name)
    plan = load_campaign(campaign, SHIPPED_CONFIGS)
    simulate_logs(SIGNALS, plan.drives(plan.days()[0])[:1])  # which loads the compiler, for seconds


# Pages


def insert(document: Path, name: str, text: str) -> None:
    """Replace what stands between `<!-- NAME -->` and `<!-- end of NAME -->` in a document."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    old = document.read_text("utf-8")
    new, replaced = re.subn(
        f"({re.escape(begin)}\n).*?({re.escape(end)})",
        lambda match: f"{match[1]}{text}\n{match[2]}",
        old,
        flags=re.DOTALL,
    )
    if replaced != 1:
        raise ValueError(f"{document} has {replaced} places called {name}")
    document.write_text(new, encoding="utf-8")
