"""What `make bench` takes, and figures of pages that it measures again: what is a fifth off."""

import hashlib
import json
import re
import statistics
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

SLOWER = 1.2
REMEMBERED = 5
"""Records that a new one is compared with, by their median."""


@dataclass(frozen=True)
class Record:
    """Processor seconds of a benchmark at a commit, and of the yardstick in the same minute."""

    commit: str
    command: str
    cpu_s: float
    yardstick_s: float

    @property
    def relative(self) -> float:
        """Processor time in yardsticks: other machines, and other load, change both."""
        return self.cpu_s / self.yardstick_s


def yardstick() -> float:
    """Return the processor time of work that is always the same: hashing, sorting, products."""
    random = np.random.default_rng(1)
    numbers, matrix = random.random(4_000_000), random.random((600, 600))
    began = time.process_time()
    for _ in range(3):
        hashlib.sha256(numbers.tobytes()).digest()
        np.sort(numbers)
        for _ in range(10):
            matrix @ matrix
        sum(i * i for i in range(500_000))
    return time.process_time() - began


def commit() -> str:
    """Return the short name of the commit that is measured, with a + if files differ from it."""
    words = ["git", "describe", "--always", "--dirty=+", "--exclude", "*"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def read_records(file: Path) -> list[Record]:
    """Return what was recorded, the oldest first."""
    lines = file.read_text("utf-8").splitlines() if file.exists() else []
    return [Record(**json.loads(line)) for line in lines]


def add_record(file: Path, record: Record) -> None:
    """Write a record behind the others."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as lines:
        lines.write(f"{json.dumps(asdict(record))}\n")


def slower_than(before: Sequence[Record], now: Record) -> str | None:
    """Return what to say if a benchmark takes a fifth longer than the median of the last ones."""
    same = [one.relative for one in before if one.command == now.command][-REMEMBERED:]
    usual = statistics.median(same) if same else now.relative
    if now.relative <= SLOWER * usual:
        return None
    return (
        f"{now.command}: {now.cpu_s:.1f} s of processors, {now.relative / usual:.2f} times what "
        f"the last {len(same)} records have, as the yardstick measures"
    )


def draw(records: Sequence[Record], plot: Path) -> None:
    """Draw each benchmark over the commits that were measured, relative to its first record."""
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    commits = list(dict.fromkeys(one.commit for one in records))
    for command in dict.fromkeys(one.command for one in records):
        mine = [one for one in records if one.command == command]
        ratios = [one.relative / mine[0].relative for one in mine]
        axes.plot([commits.index(one.commit) for one in mine], ratios, marker="o", label=command)
    axes.axhline(SLOWER, color="0.7")
    axes.set_xticks(range(len(commits)), commits, rotation=90)
    axes.set(xlabel="commit", ylabel="processor time, relative to the first record")
    axes.legend(fontsize="small")
    figure.savefig(plot)
    plt.close(figure)


ALLOWED = 0.2
_USAGE = '<!-- bench NAME: number N after "LABEL"[, yardstick S s] -->'
_MARK = re.compile(r'(\w+): number ([1-9]\d*) after "([^"]+)"(?:, yardstick ([\d.]+) s)?')
_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?")


@dataclass(frozen=True)
class PageFigure:
    """A figure as a page has it, and where a benchmark prints it; a ratio has no yardstick."""

    place: str
    written: float
    benchmark: str
    number: int
    label: str
    yardstick_s: float | None

    def departure(self, output: str, yardstick_s: float) -> str | None:
        """Return what to say if the output has a figure that is more than a fifth another."""
        rests = [line.partition(self.label)[2] for line in output.splitlines()]
        printed = next((found for found in map(_NUMBER.findall, rests) if found), [])
        told = f"{self.place}: {self.written:g} is written, but {self.benchmark}"
        if len(printed) < self.number:
            return f"{told} prints no number {self.number} after {self.label!r}"
        measured = (
            _value(printed[self.number - 1]) * (self.yardstick_s or yardstick_s) / yardstick_s
        )
        if abs(measured - self.written) <= ALLOWED * self.written:
            return None
        return f"{told} gives {measured:.4g} ({self.label!r}, as the yardstick measures)"


def page_figures(pages: Iterable[Path]) -> Iterator[PageFigure]:
    """Yield the figures that are marked in pages.

    Raises `ValueError` where a mark is wrong, or no figure stands before it.
    """
    for page in pages:
        for line, text in enumerate(page.read_text("utf-8").splitlines(), 1):
            for mark in re.finditer(r"<!-- bench .*?-->", text):
                place = f"{page.name}:{line}"
                told = _MARK.fullmatch(mark[0].removeprefix("<!-- bench ").removesuffix(" -->"))
                before = _NUMBER.findall(text[: mark.start()].rpartition("-->")[2])
                if not told or not before:
                    raise ValueError(f"{place}: write a figure and {_USAGE}, not {mark[0]}")
                benchmark, number, label, took_s = told.groups()
                written_s = float(took_s) if took_s else None
                yield PageFigure(
                    place, _value(before[-1]), benchmark, int(number), label, written_s
                )


def _value(number: str) -> float:
    return float(number.replace(",", ""))
