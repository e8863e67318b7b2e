"""Two commands of `benchmarks/interleave.py` that meet, and what must be so afterwards."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import interleave_checks as checks
from benchmarks.harness import forked
from benchmarks.interleave_checks import Drive
from benchmarks.interleave_roots import SETTLING, Inputs, let_temporary_files_age, prepare
from benchmarks.interleave_stops import Environment, Outcome, Running, command, use
from fleet_slip.errors import RefusedError

FATES = ("goes on", "dies", "dies 1 later", "dies 2 later", "dies 3 later")
ROUNDS = 3
"""So often both commands are given again until nothing fails."""
PENDING = "pending"
FORGETTING = ("retain", "forget")
UNHARMED = {0, 5, 6, 7, 8, 12}
"""Exit codes of a command that met another; 6 where a file is gone that it was about to read."""


@dataclass(frozen=True)
class Schedule:
    """A pair of commands, the point where the first stops, and its fate."""

    first: str
    second: str
    point: int
    fate: str

    def __str__(self) -> str:
        """Return it as `--only` takes it."""
        return f"{self.first}/{self.second}/{self.point}/{self.fate}"

    @property
    def die_after(self) -> int | None:
        """Points after the stop until the first command is killed; None if it continues."""
        if self.fate == FATES[0]:
            return None
        return FATES.index(self.fate) - 1


class Pair:
    """Two commands, a root on which they meet, and what they make of it if they do not meet."""

    def __init__(self, first: str, second: str, inputs: Inputs, folder: Path, roots: Any) -> None:
        self.first, self.second, self._inputs, self._roots = first, second, inputs, roots
        self._both = {first, second}
        self._before = prepare(folder / f"{first}-{second}", inputs, first, second)
        self._root = ""
        environment = inputs.environment(*self._both)
        quiet = roots.copy(self._before)
        ended = self._run(quiet, first)
        self.points = ended.points
        drives = forked(lambda: _base(str(self._before), inputs.environment())).result
        self._committed = {name: Drive(**fields) for name, fields in drives.items()}
        self._settle(quiet)
        self._expected = forked(lambda: _state(quiet, environment)).result
        self.alone = [f"alone: {finding}" for finding in self._expected["damage"]]
        self._expected["damage"] = []

    def remove(self) -> None:
        shutil.rmtree(self._before)

    def run(self, schedule: Schedule) -> list[str]:
        """Return what is wrong after a schedule."""
        root = self._root = self._roots.copy(self._before)
        first = Running(root, *self._arguments(self.first), stop_at=schedule.point)
        if not first.stopped():
            first.end()
            return []
        second = self._run(root, self.second)
        migrated = self.second == "migrate"
        findings = self._look(root, second, self.second, migrated, "while the first had stopped")
        first.go_on(schedule.die_after)
        ended = first.end()
        done = _done(self.second, second) + _done(self.first, ended)
        findings += _harm(self.first, ended) + _harm(self.second, second)
        if "repair" not in self._both:
            migrated |= self.first == "migrate" and "migrate" in done
            if schedule.die_after != 0:  # else nothing has changed since
                findings += self._look_again(root, done, migrated)
        findings += self._settle(root)
        environment = self._inputs.environment(*self._both)
        forgotten = "forget" in self._both
        final = forked(lambda: _final(root, environment, self._expected, forgotten)).result
        return [*findings, *map(str, final)]

    def _run(self, root: str, name: str) -> Outcome:
        return Running(root, *self._arguments(name)).end()

    def _arguments(self, name: str) -> tuple[tuple[str, ...], Environment]:
        return self._inputs.arguments(name), self._inputs.environment(name)

    def _look(self, root: str, outcome: Outcome, name: str, migrated: bool, when: str) -> list[str]:
        if "repair" in self._both:
            return []
        done = _done(name, outcome)
        return [f"{finding} ({when})" for finding in self._look_again(root, done, migrated)]

    def _look_again(self, root: str, done: Sequence[str], migrated: bool) -> list[str]:
        erased = {(True, True): "both", (True, False): "car", (False, True): "day"}.get(
            ("forget" in self._both, "retain" in self._both), ""
        )
        environments = [
            self._inputs.environment(*(["migrate"] if m else [])) for m in (False, True)
        ]
        if migrated:
            environments.reverse()
        committed = self._committed
        pending = PENDING in done and "forget" in self._both
        forgotten = "all" if "forget" in done else "readable" if pending else ""
        return [
            str(finding)
            for finding in forked(
                lambda: _findings(root, environments, committed, erased, forgotten)
            ).result
        ]

    def _settle(self, root: str) -> list[str]:
        """Give both commands again until both are done; return what keeps failing."""
        order = [name for name in (*SETTLING, "gram", *FORGETTING) if name in self._both]
        environment = self._inputs.environment(*self._both)
        before = self._inputs.environment("repair")  # what was simulated before it is migrated
        commands = [
            (name, self._inputs.arguments(name), before if name == "repair" else environment)
            for name in (*order, "gram")
        ]
        code, output = forked(lambda: _repeat(root, commands)).result
        return [f"keeps failing: {output}"] if code else []


def _repeat(
    root: str, commands: Sequence[tuple[str, tuple[str, ...], Environment]]
) -> tuple[int, str]:
    failed: dict[str, int] = {}
    let_temporary_files_age(root)
    for _ in range(ROUNDS):
        codes = {name: command(root, words, environment) for name, words, environment in commands}
        failed = {n: code for n, code in codes.items() if code}
        if not failed:
            break
    return len(failed), ", ".join(f"{name} ends with {code}" for name, code in failed.items())


def _base(root: str, environment: Environment) -> dict[str, Any]:
    """Return the drives that are committed and have Gram rows; none that a pair may lose first."""
    use(environment)
    warehouse = checks.warehouse_at(root)
    drives, _ = checks.drives_of(warehouse) if not _damaged(warehouse) else ({}, [])
    grams = set(checks.grams_of(warehouse)) if drives else set()
    return {name: vars(drive) for name, drive in drives.items() if name in grams}


def _damaged(warehouse: Any) -> bool:
    present = {file.path for file in warehouse.logs.folder.files()}
    return any(file.path not in present for file in warehouse.logs.snapshot().files)


def _state(root: str, environment: Environment) -> dict[str, Any]:
    use(environment)
    return checks.state(root)


def _findings(
    root: str,
    environments: Sequence[Environment],
    committed: dict[str, Drive],
    erased: str,
    forgotten: str,
) -> list[str]:
    for environment in environments:
        use(environment)
        try:
            findings = checks.readers_findings(root, committed, erased)
        except RefusedError:
            continue
        findings += checks.version_findings(root)
        if forgotten:
            findings += checks.forgotten_findings(root, forgotten == "all")
        return findings
    return ["unreadable: in the scales of either catalog"]


def _final(
    root: str, environment: Environment, expected: dict[str, Any], forgotten: bool
) -> list[str]:
    use(environment)
    state = checks.state(root)
    remaining = checks.forgotten_findings(root, unsaid=True) if forgotten else []
    return [f"{finding} (at the end)" for finding in remaining] + [
        f"other end: {key} {state[key] if key == 'damage' else ''}"
        for key in expected
        if state[key] != expected[key]
    ]


def _done(name: str, outcome: Outcome) -> list[str]:
    """Return the command if it was done; if it has said that something is pending, that."""
    return [name] if outcome.exit_code == 0 else [PENDING] if outcome.exit_code == 12 else []


def _harm(name: str, outcome: Outcome) -> list[str]:
    if outcome.exit_code is None or outcome.exit_code in UNHARMED:
        return []
    return [f"ends with {outcome.exit_code}: {name}: {outcome.output[-2000:]}"]
