"""Kills, meetings of two commands and soaks for as many hours as there are, and a verdict.

    python -m benchmarks.overnight [--hours 8] [--folder overnight] [--kills 20] [--schedules 5]
                                   [--minutes 5]

Works in pieces of minutes, in turn: `--kills` kills of one command (`benchmarks.crash`), of all
commands one after the other; `--schedules` meetings of two commands (`benchmarks.interleave`), of
all pairs, on a folder and on an S3 server; and `--minutes` of seven writers and a reader
(`benchmarks.soak`), on both. Each piece is a line of FOLDER/pieces.jsonl, with what it said. Given
again, it goes on after the last piece. FOLDER/verdict.md is rewritten after each: one page. It ends
with 1 if a piece found something.
"""

import argparse
import itertools
import json
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.crash_commands import COMMANDS as KILLED
from benchmarks.interleave_roots import COMMANDS as MEETING

TOLD = {
    "crash": re.compile(r"^(\d+) kills survived", re.MULTILINE),
    "interleave": re.compile(r"^(\d+) schedules,", re.MULTILINE),
    "soak": re.compile(r"^(\d+) commands and looks in", re.MULTILINE),
}
"""What a benchmark says of how much it did, in its last lines."""

WHAT = {
    "crash": "kills, after each of which the same command made the same bits",
    "interleave": "schedules of two commands",
    "interleave --store": "schedules of two commands on an S3 server",
    "soak": "commands and looks of seven writers and a reader",
    "soak --store": "commands and looks of seven writers and a reader on an S3 server",
}
PATIENCE_S = 7200
LAST_LINES = 80


def pieces(given: argparse.Namespace) -> Iterator[list[str]]:
    """Yield pieces without end; the n-th is the same whenever it is asked for."""
    pairs = list(itertools.product(MEETING, MEETING))
    for number in itertools.count():
        seed, store = ["--seed", str(number)], ["--store"] * (number % 2)
        name = KILLED[number % len(KILLED)].name
        yield ["crash", "--kills", str(given.kills), *seed, "--commands", name]
        first, second = pairs[number * 7 % len(pairs)]  # 7 is prime to their number
        pair = ["--first", first, "--second", second]
        yield ["interleave", *store, "--schedules", str(given.schedules), *seed, *pair]
        yield ["soak", *store, "--minutes", str(given.minutes), *seed]


def run(piece: Sequence[str]) -> dict[str, Any]:
    """Run a piece to its end; return what came of it."""
    started, command = time.time(), [sys.executable, "-m", f"benchmarks.{piece[0]}", *piece[1:]]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        code, said = done.returncode, done.stdout + done.stderr
    except subprocess.TimeoutExpired:
        code, said = -1, f"it had not ended after {PATIENCE_S} s"
    told = TOLD[piece[0]].search(said)
    return {
        "piece": list(piece),
        "code": code,
        "done": int(told[1]) if told else 0,
        "seconds": round(time.time() - started),
        "said": [] if not code else said.splitlines()[-LAST_LINES:],
    }


def verdict(done: Sequence[dict[str, Any]]) -> str:
    """Return a page: what was done, and what was found and how to see it again."""
    counts, seconds = Counter[str](), Counter[str]()
    for one in done:
        kind = one["piece"][0] + (" --store" if "--store" in one["piece"] else "")
        counts[kind] += one["done"]
        seconds[kind] += one["seconds"]
    found = [one for one in done if one["code"]]
    hours = seconds.total() / 3600
    title = f"{len(found)} of {len(done)} pieces found something" if found else "Nothing found"
    lines = [
        f"# {title}",
        "",
        f"{len(done)} pieces in {hours:.1f} hours.",
        "",
        "| done | what | hours |",
        "| ---: | --- | ---: |",
        *(f"| {counts[k]:,} | {what} | {seconds[k] / 3600:.1f} |" for k, what in WHAT.items()),
    ]
    for one in found:
        lines += ["", f"## `python -m benchmarks.{' '.join(one['piece'])}`", "", "```"]
        lines += [*one["said"], "```"]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--hours", type=float, default=8)
    parser.add_argument("--folder", type=Path, default=Path("overnight"))
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--schedules", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=5)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    kept, until = given.folder / "pieces.jsonl", time.monotonic() + 3600 * given.hours
    done = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    before = len(done)
    for piece in itertools.islice(pieces(given), before, None):
        if time.monotonic() >= until and len(done) > before:
            break
        done.append(run(piece))
        draft = kept.with_suffix(".draft")
        draft.write_text("".join(json.dumps(one) + "\n" for one in done))
        draft.replace(kept)
        (given.folder / "verdict.md").write_text(verdict(done))
        print(" ".join(piece), "found something" if done[-1]["code"] else "held", flush=True)
    print(verdict(done))
    sys.exit(any(one["code"] for one in done))


if __name__ == "__main__":
    main()
