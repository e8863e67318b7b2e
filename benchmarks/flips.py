"""Flips single bits in every kind of file of a data root, and runs every command after each.

A command may say what is wrong and end with an exit code of its own, or answer what it would answer
without the flip. A different answer with exit 0 is a wrong result; exit 1 is a bug. If it is ended
early (Ctrl-C, SIGTERM) it shows what it has counted.

    python -m benchmarks.flips [--flips 300] [--seed 0] [--kind K ...]
"""

import argparse
import collections
import contextlib
import random
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.flips_root import (
    KINDS,
    Ended,
    Flip,
    campaign,
    command,
    copied,
    digest,
    fill,
    flipped,
    write_configs,
)
from benchmarks.harness import load_code, quick_folder

READING: tuple[tuple[str, ...], ...] = (
    ("models", "--json"),
    ("show", "smoke", "--json"),
    ("select", "--json"),
    ("select", "--order", "ay,yaw_rate", "--ranking", "correlation", "--json"),
    ("score", "smoke", "--json"),
    ("quality", "--json"),
    ("diagnose", "smoke", "--json"),
    ("monitor", "smoke", "--since", "2024-05-07", "--json"),
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
    ("rollback", "smoke"),
    ("compact",),
    ("forget", "--drive", "smoke-2024-05-01-0001", "--now"),
    ("verify", "--repair"),
)

VERIFY = ("verify", "--json")

FOR_VERIFY = ("commits", "checkpoints")
"""Kinds of files whose damage `verify` finds, and no other command (docs/durability.md)."""

UNDAMAGED = (0, 5, 7, 10)
"""Exit codes that commands may have where nothing is damaged."""


@dataclass
class Counts:
    """Results for one kind of file: flips, and outcomes of the commands after them."""

    flips: int = 0
    detected: int = 0
    """Flips that `verify` found."""
    refused: int = 0
    same: int = 0
    wrong: int = 0
    bugs: int = 0
    examples: list[str] = field(default_factory=list)


FIGURES = ("flips", "detected", "refused", "same", "wrong", "bugs")


def write(root: Path, arguments: Sequence[str], flip: Flip | None) -> Ended:
    """Run a writing command on a copy; what is left of the flip is taken back before looking."""
    with copied(root) as copy:
        with flipped(copy, flip):
            ended = command(copy, *(text.format(campaign=campaign(root)) for text in arguments))
        # a refusal is no result, whatever it left
        meaning = "" if ended.exit_code else digest(copy)
        return Ended(ended.exit_code, "", ended.remarks, meaning)


def judge(counts: Counts, title: str, ended: Ended, usual: Ended) -> None:
    """Count how a command ended after a flip."""
    if ended.is_bug:
        counts.bugs += 1
        counts.examples.append(
            f"BUG {title}: exit {ended.exit_code}: {ended.remarks.strip()[-600:]}"
        )
    elif ended.exit_code != usual.exit_code:
        counts.refused += 1
    elif ended.exit_code == 0 and ended.answer != usual.answer:
        counts.wrong += 1
        counts.examples.append(f"WRONG {title}: {_difference(usual, ended)}")
    else:
        counts.same += 1


def _difference(usual: Ended, ended: Ended) -> str:
    """Return the first place where two answers differ."""
    (before, meant), (after, means) = usual.answer, ended.answer
    if before == after:
        return f"the root means something else ({meant.strip()[:80]}, {means.strip()[:80]})"
    alike = (line == other for line, other in zip(before, after, strict=False))
    place = next((n for n, same in enumerate(alike) if not same), min(len(before), len(after)))
    begin = max(0, place - 60)
    return f"{before[begin : place + 60]!r} became {after[begin : place + 60]!r}"


def choose(root: Path, number: int, seed: int, kinds: Sequence[str]) -> Iterator[tuple[str, Flip]]:
    """Yield flips, evenly over the kinds of files."""
    rng = random.Random(seed)  # noqa: S311
    for turn in range(number):
        kind = kinds[turn % len(kinds)]
        file = rng.choice(sorted(root.glob(KINDS[kind])))
        yield kind, Flip(file.relative_to(root), rng.randrange(file.stat().st_size * 8))


def run(root: Path, chosen: Sequence[tuple[str, Flip]], counts_by_kind: dict[str, Counts]) -> None:
    """Flip bits one after the other; count what commands make of each, by kind of file."""
    reading = {arguments: command(root, *arguments) for arguments in READING}
    writing = {arguments: write(root, arguments, None) for arguments in WRITING}
    for arguments, usual in (reading | writing).items():
        assert usual.exit_code in UNDAMAGED, (arguments, usual)
    for number, (kind, flip) in enumerate(chosen, 1):
        counts, shown = counts_by_kind[kind], len(counts_by_kind[kind].examples)
        counts.flips += 1
        with flipped(root, flip):
            detected = command(root, *VERIFY).exit_code == 9
            counts.detected += detected
            if detected and kind in FOR_VERIFY:
                continue
            for arguments, usual in reading.items():
                title = f"{flip}: {' '.join(arguments)}"
                judge(counts, title, command(root, *arguments), usual)
        for arguments, usual in writing.items():
            judge(counts, f"{flip}: {' '.join(arguments)}", write(root, arguments, flip), usual)
        for example in counts.examples[shown:]:
            print(example, flush=True)
        if number % 10 == 0:
            print(f"{number} flips", file=sys.stderr, flush=True)


def show(counts_by_kind: dict[str, Counts]) -> int:
    """Print the counts; return how many results were wrong, or bugs."""
    rows = {
        kind: [getattr(counts, name) for name in FIGURES] for kind, counts in counts_by_kind.items()
    }
    rows["all"] = [sum(column) for column in zip(*rows.values(), strict=True)]
    print(f"{'kind':<26}" + "".join(f"{name:>9}" for name in FIGURES))
    for kind, figures in rows.items():
        print(f"{kind:<26}" + "".join(f"{figure:>9}" for figure in figures))
    return sum(rows["all"][-2:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--flips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS), action="append")
    options = parser.parse_args()
    started = time.monotonic()
    with quick_folder() as folder:
        root = folder / "data"
        write_configs(root)
        load_code("smoke")
        fill(root)
        kinds = options.kind or list(KINDS)
        counts_by_kind: dict[str, Counts] = collections.defaultdict(Counts)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt):
            run(root, list(choose(root, options.flips, options.seed, kinds)), counts_by_kind)
    bad = show(counts_by_kind)
    print(f"{time.monotonic() - started:.0f} s")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
