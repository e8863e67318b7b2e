"""Records of what `make bench` takes, and what takes a fifth longer than before."""

import hashlib
import json
import statistics
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

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
    same = [record.relative for record in before if record.command == now.command][-REMEMBERED:]
    usual = statistics.median(same) if same else now.relative
    if now.relative <= SLOWER * usual:
        return None
    return (
        f"{now.command}: {now.cpu_s:.1f} s of processors, {now.relative / usual:.2f} times what "
        f"the last {len(same)} records have, as the yardstick measures"
    )
