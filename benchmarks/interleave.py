"""Lets every two commands that write meet at every point, and looks for what is lost or comes back.

    python -m benchmarks.interleave [--schedules N] [--seed 0] [--first C ...] [--second C ...]
                                    [--store] [--only FIRST/SECOND/POINT/FATE]

Of two commands the first is stopped just before one of its durable calls, or looks at the
warehouse; the second runs whole; then the first goes on, or dies (SIGKILL), at once or a few points
later. Then this must be so:

* no row that was committed is lost or doubled, and no reader sees half a change;
* what `forget --now` has said to be gone is in no file, and the models trained on it are marked;
* of a file that a command has taken out or forgotten no drive is there when it ends;
* a version follows, in every bit, from the Gram rows that it names;
* both commands, given again, end where they end if they never meet.

Without --schedules it tries all; with it, so many of them, chosen by the seed.
"""

import argparse
import itertools
import random
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import load_code, quick_folder
from benchmarks.interleave_pair import FATES, Pair, Schedule
from benchmarks.interleave_roots import COMMANDS, LocalRoots, StoredRoots, serving, write_inputs


def schedules(pair: Pair, fates: Sequence[str]) -> Iterator[Schedule]:
    """Yield all schedules of a pair."""
    for point, fate in itertools.product(range(1, pair.points + 1), fates):
        yield Schedule(pair.first, pair.second, point, fate)


def run(options: argparse.Namespace, folder: Path, roots: Any) -> dict[str, list[Schedule]]:
    """Run schedules; return those that found something, by what they found."""
    inputs = write_inputs(folder / "inputs")
    load_code(inputs.files["campaign"])
    rng = random.Random(options.seed)  # noqa: S311
    failures: dict[str, list[Schedule]] = defaultdict(list)
    pairs = list(itertools.product(options.first, options.second))
    done, started = 0, time.monotonic()
    for number, (first, second) in enumerate(pairs):
        if options.only and (first, second) != tuple(options.only.split("/")[:2]):
            continue
        pair = Pair(first, second, inputs, folder, roots)
        candidates = list(schedules(pair, FATES))
        if options.only:
            candidates = [candidate for candidate in candidates if str(candidate) == options.only]
        elif options.schedules:
            share = (options.schedules * (number + 1)) // len(pairs) - (
                options.schedules * number
            ) // len(pairs)
            candidates = rng.sample(candidates, min(share, len(candidates)))
        for finding in pair.alone:
            failures[f"{first} | {second}: {finding}"].append(Schedule(first, second, 0, FATES[0]))
        for schedule in candidates:
            for finding in sorted(set(pair.run(schedule))):
                failures[f"{first} | {second}: {finding}"].append(schedule)
        done += len(candidates)
        pair.remove()
        worst = Counter(
            {k: len(v) for k, v in failures.items() if k.startswith(f"{first} | {second}:")}
        )
        print(
            f"{first:11s} {second:11s} {len(candidates):4d} schedules {worst.total():4d} findings",
            flush=True,
        )
    print(f"{done} schedules, {time.monotonic() - started:.0f} s")
    return failures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--schedules", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--second", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--store", action="store_true")
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    with quick_folder() as folder:
        if options.store:
            with serving() as server:
                failures = run(options, folder, StoredRoots(*server))
        else:
            failures = run(options, folder, LocalRoots(folder))
    for finding, by in sorted(failures.items()):
        print(f"{len(by):4d} x {finding}\n       --only '{by[0]}'")
    print(f"{sum(map(len, failures.values()))} findings of {len(failures)} kinds")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
