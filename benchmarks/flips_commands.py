"""The commands that `benchmarks/flips.py` gives after each flip, and how they end."""

import contextlib
import importlib
import os
import pkgutil
import re
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fleet_slip as package
from fleet_slip.cli.main import main as fleet_slip
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.job import simulate_logs

TIMEOUT_S = 300

READING: tuple[tuple[str, ...], ...] = (
    ("models", "--json"),
    ("show", "smoke", "--json"),
    ("select", "--json"),
    ("select", "--nested", "ay,yaw_rate", "--rank", "correlation", "--json"),
    ("score", "smoke", "--json"),
    ("quality", "--json"),
    ("diagnose", "smoke", "--json"),
    ("what-if", "smoke", "--noise", "ay=0.1", "--json"),
    ("monitor", "smoke", "--since", "2024-05-07", "--json"),
    ("diff", "smoke@1", "smoke@2", "--json"),
    ("status", "--json"),
    ("verify", "--grams", "--json"),
    ("sql", "SELECT drive_id, avg(ay_mps2), max(tick) FROM log GROUP BY 1 ORDER BY 1", "--json"),
    ("sql", "FROM drives ORDER BY ALL", "--json"),
    ("sql", "FROM grams ORDER BY ALL", "--json"),
    ("sql", "FROM quarantine ORDER BY ALL", "--json"),
    ("sql", "FROM models ORDER BY ALL", "--json"),
    ("sql", "SELECT run_id, command, arguments, outcome, rows FROM runs ORDER BY ALL", "--json"),
)  # fmt: skip

WRITING: tuple[tuple[str, ...], ...] = (
    ("gram", "--json"),
    ("run", "--campaign", "{campaign}", "--threads", "1", "--json"),
    ("publish", "other", "--cohort", "adhesion > 0", "--json"),
    ("promote", "smoke@1"),
    ("promote", "smoke", "--previous"),
    ("compact",),
    ("forget", "--drive", "smoke-2024-05-01-0001", "--now"),
    ("verify", "--repair", "--campaign", "{campaign}"),
)

VERIFY = ("verify", "--json")

PASSING = re.compile(
    r'"(seconds|at|host|process|run_id|sha256'
    r'|[a-z_]*(_at|hours|age|bytes|fraction)[a-z_]*)": [^,}\]]*'
)
"""What differs from run to run."""

NUMBER = re.compile(r"-?\d+\.\d+(e-?\d+)?")
"""Averages of floating-point numbers have other last digits on other threads."""


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, what it printed, and what the root then meant."""

    exit_code: int
    printed: str
    remarks: str
    meaning: str = ""

    @property
    def answer(self) -> tuple[str, str]:
        """What must be the same wherever it ended well."""
        printed = PASSING.sub("", self.printed)
        return NUMBER.sub(lambda found: f"{float(found[0]):.9g}", printed), self.meaning

    @property
    def is_bug(self) -> bool:
        """Whether it ended as nothing may end: exit 1, a signal, or a traceback."""
        return self.exit_code == 1 or self.exit_code < 0 or "Traceback" in self.remarks


def in_a_child(work: Callable[[], Any]) -> Ended:
    """Do work in a forked process, which has its own threads and ends with them."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if not child:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            signal.alarm(TIMEOUT_S)
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            code = 1
            try:
                work()
                code = 0
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else 0
            except BaseException:
                traceback.print_exc()
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)
        _, status = os.waitpid(child, 0)
        texts = [
            (stream.seek(0), stream.read().decode(errors="replace"))[1] for stream in (out, err)
        ]
    return Ended(os.waitstatus_to_exitcode(status), *texts)


def command(root: Path, *arguments: str) -> Ended:
    """Run a command on a root."""

    def work() -> None:
        sys.argv = ["fleet-slip", "--root", str(root), *arguments]
        fleet_slip()

    return in_a_child(work)


def preload(campaign: Path) -> None:
    """Load in this process what commands load when they are called; make hashing names fast."""
    for found in pkgutil.walk_packages(package.__path__, "fleet_slip."):
        with contextlib.suppress(ImportError):  # an extra that is not there
            importlib.import_module(found.name)
    importlib.import_module("pandas")
    plan = load_campaign(str(campaign))
    simulate_logs(plan.drives(plan.days()[0])[:1])  # which loads the compiler, for seconds
