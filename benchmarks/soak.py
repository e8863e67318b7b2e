"""Lets seven writers and a reader work on one root for minutes, and kills and fails them at random.

    python -m benchmarks.soak [--minutes 60] [--seed 0] [--store]

Simulation, ingest, Gram job, publishing, compaction, vacuum and erasure run beside each other, each
again and again. Of their commands some are killed (SIGKILL) at a random moment, and in some a
random durable call fails: the disk is full, or an I/O error. With --store they work on an S3 server
that is slow and fails some requests, half of them after they were done. The reader sees whole
states only. At the end everything is given again until it is done; then nothing may be damaged,
lost or doubled, and no forgotten car be in any file.
"""

import argparse
import errno
import json
import os
import random
import re
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from benchmarks import interleave_checks as checks
from benchmarks.harness import forked, load_code
from benchmarks.interleave_roots import (
    PUBLISH,
    Inputs,
    let_temporary_files_age,
    measure,
    serving,
    write_inputs,
)
from benchmarks.interleave_stops import POINTS, Environment, command, use
from fleet_slip.errors import StorageError
from fleet_slip.warehouse.database import database_errors

KILLED, FAILED = 0.15, 0.15
"""Shares of the commands that are killed, and in which a call fails."""
FAULTS = (errno.ENOSPC, errno.EIO)
CALLS = 40
"""The call that fails is one of the first so many."""
SETTLING = 5
"""So often everything is given again at the end."""
DELETED = "a file was deleted during a look"
GONE = r"\.parquet.* is gone|No such file|No files found"
"""Errors that a reader may get, with their messages; it repeats the query."""

Arguments = tuple[str, ...]


@dataclass(frozen=True)
class Soak:
    """The data root of the run, and its end."""

    root: str
    inputs: Inputs
    environment: Environment
    until: float

    def write(self, name: str, choose: Callable[[int], Arguments], seed: int) -> Mapping[str, int]:
        """Give a command again and again; return how often what came of it."""
        rng, counts, number = random.Random(seed), Counter[str](), 0  # noqa: S311
        longest = 1.0
        while time.monotonic() < self.until:
            fate, number = rng.random(), number + 1
            arguments, call = choose(number), 0
            if fate < FAILED:
                call = rng.randrange(1, CALLS)
            kill = rng.uniform(0, longest) if FAILED <= fate < FAILED + KILLED else None
            code = rng.choice(FAULTS)
            ended = forked(lambda a=arguments, c=call, e=code: self._give(a, c, e), kill)  # type: ignore[misc]
            longest = max(longest, ended.seconds)
            counts[f"{name}: {'killed' if ended.killed else f'exit {ended.result}'}"] += 1
        return counts

    def _give(self, arguments: Arguments, call: int, code: int) -> int:
        if call:
            _fail_at(call, code)
        return command(self.root, arguments, self.environment)

    def read(self) -> Mapping[str, int]:
        """Look at whole states again and again."""
        counts = Counter[str]()
        while time.monotonic() < self.until:
            for finding in forked(self._look).result or ["looks"]:
                counts[f"reader: {finding}"] += 1
        return counts

    def _look(self) -> list[str]:
        use(self.environment)
        try:
            with database_errors("looking"):
                return checks.readers_findings(self.root, {}, "both")
        except StorageError as error:  # `forget --now` deletes replaced files, whoever reads them
            return [DELETED if re.search(GONE, str(error)) else str(error)]


def _fail_at(call: int, code: int) -> None:
    """Let one of the calls that make something durable fail."""
    passed = 0

    def failing(function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            nonlocal passed
            passed += 1
            if passed == call:
                raise OSError(code, os.strerror(code))
            return function(*arguments, **options)

        return wrapped

    for owner, name in POINTS:
        if owner is Path:
            setattr(owner, name, failing(getattr(owner, name)))


def writers(inputs: Inputs) -> Mapping[str, Callable[[int], Arguments]]:
    """Return what each writer gives the n-th time."""
    files = inputs.files

    def ingest(number: int) -> Arguments:
        path = inputs.folder / f"soak-{number}.csv"
        measure(path, (f"gone-{number // 4}", f"car-{number}"))
        return ("ingest", str(path), "--mapping", files["mapping"])

    return {
        "simulate": lambda n: (*inputs.arguments("simulate"), "--days", str(1 + n % 3)),
        "ingest": ingest,
        "gram": lambda _: ("gram",),
        "publish": lambda _: PUBLISH,
        "compact": lambda _: ("compact",),
        "forget": lambda n: ("forget", "--vehicle", f"gone-{n // 3}", "--now"),
    }


def settle(soak: Soak) -> list[str]:
    """Give everything again until it is done; return what is wrong then."""
    use(soak.environment)
    cars = sorted({f"gone-{n // 4}" for n in range(1, 10_000)} & _cars(soak.inputs))
    commands: list[Arguments] = [("compact",), ("gram",)]
    commands += [("forget", "--vehicle", car, "--now") for car in cars]
    let_temporary_files_age(soak.root)
    for _ in range(SETTLING):
        codes = [command(soak.root, arguments, soak.environment) for arguments in commands]
        if not set(codes) - {0, 5}:
            break
    findings = [f"keeps failing: {codes}"] if set(codes) - {0, 5} else []
    findings += checks.readers_findings(soak.root, {}, "both")
    findings += [f"damage: {damage}" for damage in checks.state(soak.root)["damage"]]
    remaining = {
        drive.vehicle_id for drive in checks.drives_of(checks.warehouse_at(soak.root))[0].values()
    }
    return findings + [f"readable: {car}" for car in remaining & set(cars)]


def _cars(inputs: Inputs) -> set[str]:
    return {
        line.split(",")[1]
        for path in inputs.folder.glob("soak-*.csv")
        for line in path.read_text(encoding="utf-8").splitlines()[1:]
    }


def _answer(job: Callable[[], Mapping[str, int]], answer: Path) -> NoReturn:
    """Do a job of a process of its own, which must not clean up what belongs to its parent."""
    try:
        answer.write_text(json.dumps(job()))
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def run(options: argparse.Namespace, folder: Path, url: str) -> int:
    """Let all work until the time is over; print counts and findings."""
    inputs = write_inputs(folder / "inputs")
    load_code(inputs.files["campaign"])
    soak = Soak(
        url or str(folder / "root"),
        inputs,
        inputs.environment(),
        time.monotonic() + 60 * options.minutes,
    )
    forked(lambda: command(soak.root, inputs.arguments("simulate"), soak.environment))
    forked(lambda: command(soak.root, ("gram",), soak.environment))
    answers = []
    jobs: dict[str, Callable[[], Mapping[str, int]]] = {
        name: lambda n=name, c=choose, s=place: soak.write(n, c, options.seed + s)  # type: ignore[misc]
        for place, (name, choose) in enumerate(writers(inputs).items())
    }
    for name, job in {**jobs, "reader": soak.read}.items():
        answers.append(folder / f"{name}.json")
        if not os.fork():
            _answer(job, answers[-1])
    for _ in answers:
        os.wait()
    counts = Counter[str]()
    for answer in answers:
        counts.update(
            json.loads(answer.read_text()) if answer.exists() else {f"{answer.stem}: died": 1}
        )
    for title, count in sorted(counts.items()):
        print(f"{count:6d} x {title}")
    sound = ("reader: looks", f"reader: {DELETED}")
    findings = [title for title in counts if title.startswith("reader: ") and title not in sound]
    findings += [title for title in counts if title.endswith((": died", "exit 1"))]
    findings += forked(lambda: settle(soak)).result
    print("\n".join(findings))
    print(f"{counts.total()} commands and reads in {options.minutes} min, {len(findings)} findings")
    return bool(findings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", action="store_true")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as name,
        serving(failing=0.02, slow_s=0.05) if options.store else nullcontext(("", "")) as server,
    ):
        url = f"s3://{server[1]}/soak" if options.store else ""
        sys.exit(run(options, Path(name), url))


if __name__ == "__main__":
    main()
