"""The long run: python -m benchmarks.fuzz --cases 20000 [--seed 1] [--target csv] [--only 123]."""

import argparse
import json
import multiprocessing
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

ADDRESS_SPACE_BYTES = 12 * 2**30
"""Limit of a process's address space; threads and allocators reserve much that they never use."""
RESIDENT_LIMIT_BYTES = 2 * 2**30
CASE_LIMIT_S = 60.0
START_LIMIT_S = 120.0
CASES_PER_PROCESS = 250
PROCESSES = 2


@dataclass
class Outcome:
    """The outcomes of a target's cases."""

    answers: Counter[str] = field(default_factory=Counter)
    bugs: list[str] = field(default_factory=list)
    seconds: float = 0.0
    resident_bytes: int = 0


def main() -> int:
    """Run cases of every target, or of one; return 1 if any of them is a bug."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", help="only this one")
    parser.add_argument("--only", type=int, help="only the case with this number, in this process")
    options = parser.parse_args()
    from tests.support.fuzz.targets import TARGETS  # noqa: PLC0415 - processes load it themselves

    chosen = [options.target] if options.target else list(TARGETS)
    if options.only is not None:
        print(*_case(chosen[0], options.seed, options.only), sep="\n")
        return 0
    cases = {
        name: options.cases if options.target else -(-options.cases * TARGETS[name][1] // 100)
        for name in chosen
    }
    outcomes = {name: Outcome() for name in chosen}
    started = time.monotonic()
    parts = [
        (name, range(first, min(first + CASES_PER_PROCESS, cases[name])))
        for name in chosen
        for first in range(0, cases[name], CASES_PER_PROCESS)
    ]
    with ThreadPoolExecutor(PROCESSES) as executor:
        done = executor.map(
            lambda part: _supervise(part[0], part[1], options.seed, outcomes), parts
        )
        for (name, numbers), _ in zip(parts, done, strict=True):
            print(f"{name} {numbers.stop} of {cases[name]}", file=sys.stderr, flush=True)
    _report(outcomes, time.monotonic() - started)
    return 1 if any(outcome.bugs for outcome in outcomes.values()) else 0


def _supervise(name: str, numbers: range, seed: int, outcomes: dict[str, Outcome]) -> None:
    """Run cases in processes; one that dies or hangs is a bug, and the next goes on behind it."""
    outcome, position = outcomes[name], 0
    context = multiprocessing.get_context("spawn")
    while position < len(numbers):
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, name, numbers[position:], seed))
        process.start()
        theirs.close()
        limit_s = START_LIMIT_S
        began = time.monotonic()
        try:
            while position < len(numbers):
                if not ours.poll(limit_s):
                    outcome.bugs.append(f"{name} {numbers[position]}: no answer in {limit_s:g} s")
                    position += 1
                    break
                message = ours.recv()
                limit_s = CASE_LIMIT_S
                position += 1
                outcome.answers[message["answer"]] += 1
                outcome.resident_bytes = max(outcome.resident_bytes, message["resident_bytes"])
                if message["bug"]:
                    outcome.bugs.append(f"{name} {message['number']}: {message['bug']}")
        except EOFError:
            process.join()
            outcome.bugs.append(f"{name} {numbers[position]}: died with {process.exitcode}")
            position += 1
        finally:
            process.kill()
            process.join()
            outcome.seconds += time.monotonic() - began


def _work(pipe: Connection, name: str, numbers: range, seed: int) -> None:
    """Run cases in this process, with limits, in a folder of their own."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
    for number in numbers:
        answer, bug = _case(name, seed, number)
        resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        if not bug and resident > RESIDENT_LIMIT_BYTES:
            bug = f"{resident:,} bytes of memory"
        content = {"number": number, "answer": answer, "bug": bug, "resident_bytes": resident}
        pipe.send(content)
        if bug and resident > RESIDENT_LIMIT_BYTES:
            sys.exit(1)


def _case(name: str, seed: int, number: int) -> tuple[str, str]:
    """Run one case. Return what it came to, and what is wrong with that, if anything."""
    from fleet_slip.errors import FleetSlipError  # noqa: PLC0415
    from tests.support.fuzz.targets import TARGETS  # noqa: PLC0415

    sandbox = _sandbox()
    place = sandbox / "case"
    place.mkdir()
    try:
        TARGETS[name][0](random.Random(f"{seed} {name} {number}"), place)  # noqa: S311
    except FleetSlipError as error:
        text = str(error)
        bug = "" if text.isprintable() and len(text) < 20_000 else f"message: {text[:200]!r}"
        return type(error).__name__, bug
    except BaseException:  # whatever it is, it is what we look for
        return "bug", traceback.format_exc()
    else:
        strays = [entry.name for entry in sandbox.iterdir() if entry.name not in _KNOWN]
        return "answered", f"files outside: {strays}" if strays else ""
    finally:
        shutil.rmtree(place, ignore_errors=True)


_KNOWN = {"case", "template"}
_sandboxes: list[Any] = []


def _sandbox() -> Path:
    """Return this process's folder, which is also its working directory, home and TMPDIR."""
    if not _sandboxes:
        import os  # noqa: PLC0415

        _sandboxes.append(tempfile.TemporaryDirectory(prefix="fleet-slip-fuzz-"))
        folder = Path(_sandboxes[0].name)
        os.chdir(folder)
        os.environ["HOME"] = os.environ["TMPDIR"] = str(folder)
        tempfile.tempdir = str(folder)
    return Path(_sandboxes[0].name)


def _report(outcomes: dict[str, Outcome], seconds: float) -> None:
    total = 0
    for name, outcome in outcomes.items():
        count = outcome.answers.total()
        total += count
        print(
            f"{name:<12}{count:>7} cases {outcome.seconds:>7.0f} s "
            f"{outcome.resident_bytes / 2**20:>6.0f} MiB  {dict(outcome.answers.most_common())}"
        )
    bugs = [bug for outcome in outcomes.values() for bug in outcome.bugs]
    for bug in bugs[:50]:
        print(bug)
    summary = {"cases": total, "bugs": len(bugs), "seconds": round(seconds)}
    print(json.dumps(summary))
