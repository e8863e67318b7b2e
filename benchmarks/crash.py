"""Kills commands (SIGKILL) in mid-work, repeats them, and compares every bit with a quiet run.

    python -m benchmarks.crash [--kills 300] [--seed 0] [--commands simulate gram ...]

A command dies either at a named point, before or after a call that makes something durable, or at
a random moment. Then nothing may be damaged; and after the same command has been given again the
rows, Gram rows, quarantine, model versions, aliases and records of forgetting must be those of a
root on which it was never killed. What a killed job left may be of one that runs, as long as it is
young: `forget --now` may ask to be repeated for it, and it is repeated then as if an hour later.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from deltalake import DeltaTable

from benchmarks.crash_commands import COMMANDS, Command, prepare_inputs
from benchmarks.harness import call, forked, load_code
from fleet_slip.errors import PendingError
from fleet_slip.grams.on_board import onboard_feature_sets
from fleet_slip.models.registry import Registry
from fleet_slip.operations.verify import verify
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Table
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.gram_reader import BEING_WRITTEN_HOURS
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG

POINTS: tuple[tuple[Any, str], ...] = (
    (pq, "write_table"),
    (os, "fsync"),
    (Path, "replace"),
    (Path, "rename"),
    (Path, "unlink"),
    (Path, "hardlink_to"),
    (Path, "mkdir"),
    (DeltaTable, "create"),
    (DeltaTable, "create_write_transaction"),
)
"""Calls that make something durable, or are about to. Each is a point twice: before and after."""


class Countdown:
    """Counts the points that were passed, and kills the process at one of them."""

    def __init__(self, fatal: int) -> None:
        self.fatal = fatal
        self.passed = 0

    def point(self) -> None:
        self.passed += 1
        if self.passed == self.fatal:
            os.kill(os.getpid(), signal.SIGKILL)

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            self.point()
            result = function(*arguments, **options)
            self.point()
            return result

        return wrapped


def give(root: Path, arguments: tuple[str, ...], fatal: int = 0) -> int:
    """Run one command in this process; return how many points it passed."""
    countdown = Countdown(fatal)
    for owner, name in POINTS:
        setattr(owner, name, countdown.around(getattr(owner, name)))
    assert not call(root, arguments), f"{arguments} did not end with 0"
    return countdown.passed


def repeat(root: Path, arguments: tuple[str, ...]) -> None:
    """Run a command that was killed again, as a person would."""
    code = call(root, arguments)
    if code == PendingError.exit_code:
        let_an_hour_pass(root)
        code = call(root, arguments)
    assert code == 0, f"{arguments} ended with {code}"


def let_an_hour_pass(root: Path) -> None:
    """Make every file older than one that a running job may be writing."""
    then = time.time() - 3600 * BEING_WRITTEN_HOURS - 1
    for file in root.rglob("*"):
        if file.is_file():
            os.utime(file, (then, then))


def state(root: Path) -> dict[str, Any]:
    """All that a root holds, apart from file names and the moments at which it was written."""
    warehouse = Warehouse(LocalFolder(root))
    registry = Registry(LocalFolder(root), CATALOG)
    names = registry.names()
    histories = {name: registry.history(name) for name in names}
    return {
        "tables": {table.folder.name: _digest(table, warehouse) for table in warehouse.tables},
        "versions": {
            n: [registry.load(n, number).sha256 for number in registry.versions(n)] for n in names
        },
        "aliases": {name: moves.aliases() for name, moves in histories.items()},
        "moves": {
            name: [(move.command, move.version) for move in moves.moves()]
            for name, moves in histories.items()
        },
        "forgotten": [
            [entry["event"], entry.get("drives"), entry.get("models")]
            for entry in ErasureLog(LocalFolder(root)).entries()
        ],
        "damage": [str(finding) for finding in verify(warehouse, full=True).damage],
    }


def _digest(table: Table, warehouse: Warehouse) -> list[Any]:
    """Return the number of rows that count, and a hash of them, whatever files they are in."""
    parts = [pq.read_table(path, partitioning=None) for path in table.snapshot().paths]
    rows = [row for part in parts for row in part.to_pylist()]
    if table.folder.name == "grams":  # a Gram row counts while its log file is active
        active = {file.path for file in warehouse.logs.snapshot().files}
        rows = [row for row in rows if row.pop("file") in active]
    texts = sorted(json.dumps(row, sort_keys=True, default=str) for row in rows)
    return [len(texts), hashlib.sha256("\n".join(texts).encode()).hexdigest()]


def damage(root: Path) -> list[str]:
    warehouse = Warehouse(LocalFolder(root))
    if all(table.snapshot().version is None for table in warehouse.tables):
        return []  # killed before there was anything, which `verify` refuses
    return [str(finding) for finding in verify(warehouse).damage]


def root_after(commands: tuple[tuple[str, ...], ...], folder: Path, inputs: dict[str, str]) -> Path:
    """Return a root on which commands were given, each of them once for all that come later."""
    root = folder / hashlib.sha256(repr(commands).encode()).hexdigest()
    if not commands:
        root.mkdir(exist_ok=True)
    elif not root.exists():
        shutil.copytree(root_after(commands[:-1], folder, inputs), root)
        forked(partial(give, root, tuple(part.format(**inputs) for part in commands[-1])))
    return root


class Harness:
    """A root prepared for one command, and what the command makes of it undisturbed."""

    def __init__(self, command: Command, folder: Path, inputs: dict[str, str]) -> None:
        self.command = command
        self.arguments = tuple(part.format(**inputs) for part in command.arguments)
        self.folder = folder
        self.before = root_after(command.before, folder.parent, inputs)
        if arrange := command.arrange:
            self.before = shutil.copytree(self.before, folder / "before")
            forked(partial(arrange, self.before))
        quiet = self.copy()
        ended = forked(lambda: give(quiet, self.arguments))
        self.points: int = ended.result
        self.seconds = ended.seconds
        self.expected = forked(lambda: state(quiet)).result
        assert not self.expected["damage"], self.expected["damage"]

    def copy(self) -> Path:
        root = self.folder / "root"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.before, root)
        return root

    def kill(self, rng: random.Random, number: int) -> str | None:
        """Kill once, repeat and compare. Return at what kind of point, or None if it was too late.

        Even numbers are named points, in turn over the whole command; odd ones random moments.
        """
        root = self.copy()
        if number % 2 == 0 and self.points:
            point = 1 + (number // 2 * 7919 + rng.randrange(self.points)) % self.points
            ended = forked(lambda: give(root, self.arguments, point))
            where = "at a named point"
        else:
            ended = forked(
                lambda: give(root, self.arguments), kill_after_s=rng.uniform(0, self.seconds)
            )
            where = "at a random moment"
        if not ended.killed:
            return None

        def look_and_repeat() -> list[Any]:
            findings = [] if self.command.damaged else damage(root)
            repeat(root, self.arguments)
            return [findings, state(root)]

        faults, after = forked(look_and_repeat).result
        assert not faults, f"{self.command.name}: after a kill {where}: {faults}"
        assert after == self.expected, (
            f"{self.command.name}: after a kill {where}\n{after}\ninstead of\n{self.expected}"
        )
        return where


def run(kills: int, seed: int, names: list[str]) -> Counter[tuple[str, str]]:
    """Kill so many times in all, the commands in turn. Raises `AssertionError` if it shows."""
    rng = random.Random(seed)  # noqa: S311
    done: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        inputs = prepare_inputs(Path(folder))
        load_code(inputs["campaign"])
        onboard_feature_sets(CATALOG)  # once for all forks
        chosen = [command for command in COMMANDS if command.name in names]
        for place, command in enumerate(chosen):
            share = kills // len(chosen) + (place < kills % len(chosen))
            harness = Harness(command, Path(folder) / command.name, inputs)
            number = 0
            while sum(n for (name, _), n in done.items() if name == command.name) < share:
                where = harness.kill(rng, number)
                number += 1
                if where:
                    done[command.name, where] += 1
            shutil.rmtree(harness.folder)
            print(
                f"{command.name:24s} {share:4d} kills survived, {harness.points} points", flush=True
            )
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    names = [command.name for command in COMMANDS]
    parser.add_argument("--commands", nargs="+", choices=names, default=names)
    options = parser.parse_args()
    started = time.monotonic()
    done = run(options.kills, options.seed, options.commands)
    by_kind: Counter[str] = Counter()
    for (_, where), count in done.items():
        by_kind[where] += count
    kinds = ", ".join(f"{count} {where}" for where, count in sorted(by_kind.items()))
    print(
        f"{done.total()} kills survived ({kinds}), nothing lost or doubled, "
        f"{time.monotonic() - started:.0f} s"
    )


if __name__ == "__main__":
    main()
