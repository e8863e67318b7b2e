"""The cost of each command as a data root grows: log files, Gram rows or model versions.

    python -m benchmarks.growth --root FOLDER [--part files gram-rows ...] [--sizes 1e3 1e4]

Every command runs in a process of its own. Prints a Markdown table for each part: processor
seconds at each size, which other work on the machine disturbs little, the slope between the two
largest, and the peak memory at the largest. A command that does not need what grows should have a
slope near 0; none should have more than 1.
"""

import argparse
import math
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.billion import PROGRAM
from benchmarks.usage import Usage, measured
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support import growth_history as history

MODEL = "growth"
BASE_FILES = 10
GRAM_FILES = 1000
BASE_GRAMS = 100

GRAM = ("gram",)
SELECT = ("select",)
COHORT = ("select", "--cohort", "adhesion < 0.8")
PUBLISH = ("publish", MODEL)
STATUS = ("status",)
MODELS = ("models",)
SHOW = ("show", MODEL)
MONITOR = ("monitor", MODEL, "--since", "2020-01-06")
QUALITY = ("quality",)
COUNT_GRAMS = ("sql", "SELECT count(*) FROM grams")
COUNT_MODELS = ("sql", "SELECT count(*) FROM models")
ONE_DAY = ("sql", "SELECT count(*) FROM log_counts WHERE day = DATE '2020-01-02'")
LAND = ("simulate", "smoke", "--days", "1")
FORGET = ("forget", "--vehicle", "car-00000003", "--now")

Command = tuple[str, ...]


@dataclass(frozen=True)
class Part:
    """One thing that grows.

    Attributes:
        make: fills a data root with so many.
        sizes: how many.
        commands: what is measured, in this order, on the same root.
    """

    make: Callable[[Path, int], None]
    sizes: tuple[int, ...]
    commands: tuple[Command, ...]


def files(root: Path, count: int) -> None:
    history.write_fleet(Warehouse(LocalFolder(root)), count)


def gram_rows(root: Path, count: int) -> None:
    history.write_fleet(Warehouse(LocalFolder(root)), GRAM_FILES, count)


def versions(root: Path, count: int) -> None:
    history.write_fleet(Warehouse(LocalFolder(root)), BASE_FILES, BASE_GRAMS)
    command(root, PUBLISH)
    history.write_versions(root, MODEL, count)


PARTS = {
    "files": Part(
        files,
        (1000, 10_000, 100_000),
        (
            *(PUBLISH, GRAM, SELECT, STATUS, MONITOR, QUALITY, COUNT_GRAMS, ONE_DAY),
            *(LAND, GRAM, FORGET),
        ),
    ),
    "gram-rows": Part(
        gram_rows,
        (100_000, 1_000_000, 10_000_000),
        (PUBLISH, GRAM, SELECT, COHORT, STATUS, COUNT_GRAMS, LAND, GRAM),
    ),
    "versions": Part(
        versions,
        (1000, 10_000, 100_000),
        (MODELS, SHOW, SELECT, PUBLISH, STATUS, COUNT_GRAMS, COUNT_MODELS),
    ),
}


def command(root: Path, arguments: Sequence[str]) -> Usage:
    """Run a command; an alarm (exit code 10) is an answer, too."""
    return measured([*PROGRAM, "--root", str(root), *arguments, "--json"], answers=(0, 10))


def grow(name: str, sizes: Sequence[int], folder: Path) -> dict[str, list[Usage]]:
    """Measure every command of a part at every size."""
    part = PARTS[name]
    usages_by_command: dict[str, list[Usage]] = {}
    for size in sizes:
        root = folder / f"{name}-{size}" / "data"
        root.mkdir(parents=True)
        part.make(root, size)
        seen: dict[str, int] = {}
        for arguments in part.commands:
            usage = command(root, arguments)
            text = " ".join(arguments)
            seen[text] = seen.get(text, 0) + 1
            text += " (again)" * (seen[text] - 1)
            usages_by_command.setdefault(text, []).append(usage)
            print(f"{name} {size:>9,}  {text:<70} {usage.cpu_s:8.2f} CPU-s", file=sys.stderr)
        shutil.rmtree(root.parent)
    return usages_by_command


def markdown(name: str, sizes: Sequence[int], usages_by_command: dict[str, list[Usage]]) -> str:
    """Return a part's figures as a Markdown table."""
    head = [f"{name}: processor seconds", *(f"{n:,}" for n in sizes), "slope", "peak MiB"]
    lines = [" | ".join(head), " | ".join(["---", *["---:"] * (len(head) - 1)])]
    for text, usages in usages_by_command.items():
        times = [usage.cpu_s for usage in usages]
        cells = [f"`{text}`", *(f"{s:.2f}" for s in times)]
        rise = math.nan
        if len(sizes) > 1:
            rise = math.log(times[-1] / times[-2]) / math.log(sizes[-1] / sizes[-2])
        cells += [f"{rise:.2f}", f"{usages[-1].peak_bytes / 2**20:,.0f}"]
        lines.append(" | ".join(cells))
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--root", type=Path, default=Path("data-growth"), help="where to work")
    parser.add_argument("--part", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--sizes", type=float, nargs="*", help="default: those of the part")
    options = parser.parse_args()
    for name in options.part:
        sizes = [round(s) for s in options.sizes] if options.sizes else PARTS[name].sizes
        print(markdown(name, sizes, grow(name, sizes, options.root)) + "\n", flush=True)


if __name__ == "__main__":
    main()
