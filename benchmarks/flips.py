"""Flips single bits in every kind of file of a data root, and runs every command after each.

A command may say what is wrong and end with an exit code of its own, or answer what it would answer
without the flip. A different answer with exit 0 is a wrong result; exit 1 is a bug.

    python -m benchmarks.flips --flips 300
"""

import argparse
import collections
import contextlib
import hashlib
import importlib
import json
import os
import pkgutil
import random
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

import fleet_slip as package
from fleet_slip.cli.main import main as fleet_slip
from fleet_slip.delta import Change
from fleet_slip.delta.checkpoints import seal_checkpoints
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.resources import find_config
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, Warehouse

TIMEOUT_S = 300

KINDS = {
    "logs": "logs/day=*/*.parquet",
    "Gram rows": "grams/*.parquet",
    "quarantine": "quarantine/*.parquet",
    "commits": "*/_delta_log/*.json",
    "checkpoints": "*/_delta_log/*.checkpoint.parquet",
    "last checkpoint": "*/_delta_log/_last_checkpoint",
    "checksums of checkpoints": "*/_checkpoints/*.json",
    "manifests": "models/*/versions/*.json",
    "histories": "models/*/history/*.json",
    "evaluations": "evaluations/*.json",
    "forgotten": "forgotten/*.json",
    "run records": "runs/*.jsonl",
}

READING: tuple[tuple[str, ...], ...] = (
    ("models", "--json"),
    ("show", "smoke", "--json"),
    ("select", "--json"),
    ("select", "--nested", "ay,yaw_rate", "--rank", "correlation", "--json"),
    ("score", "smoke", "--json"),
    ("quality", "--json"),
    ("diagnose", "smoke", "--json"),
    ("what-if", "smoke", "--noise", "ay=0.1", "--json"),
    ("shrink", "--signals", "ay,yaw_rate", "--json"),
    ("monitor", "smoke", "--since", "2024-05-07", "--json"),
    ("check", "--json"),
    ("sql", "SELECT drive_id, avg(ay_mps2), max(tick) FROM log GROUP BY 1 ORDER BY 1", "--json"),
    ("sql", "FROM drives ORDER BY ALL", "--json"),
    ("sql", "FROM grams ORDER BY ALL", "--json"),
    ("sql", "FROM quarantine ORDER BY ALL", "--json"),
    ("sql", "FROM models ORDER BY ALL", "--json"),
    ("sql", "SELECT run_id, command, arguments, outcome, rows FROM runs ORDER BY ALL", "--json"),
)  # fmt: skip

WRITING: tuple[tuple[str, ...], ...] = (
    ("gram", "--json"),
    ("run", "--campaign", "{campaign}", "--json"),
    ("publish", "other", "--cohort", "adhesion > 0", "--json"),
    ("rollback", "smoke"),
    ("compact",),
    ("forget", "--drive", "smoke-2024-05-01-0001", "--now"),
)

VERIFY = ("verify", "--json")

PASSING = re.compile(
    r'"(seconds|at|started_at|ended_at|published_at|host|process|run_id|sha256)": [^,}\]]*'
)
"""What differs from run to run."""


NUMBER = re.compile(r"-?\d+\.\d+(e-?\d+)?")
"""Averages of floating-point numbers have other last digits on other threads."""


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, what it printed, and what the root then meant."""

    exit_code: int
    printed: str
    remarks: str
    meaning: str = ""

    @property
    def answer(self) -> tuple[str, str]:
        """What must be the same wherever it ended well."""
        printed = PASSING.sub("", self.printed)
        return NUMBER.sub(lambda found: f"{float(found[0]):.9g}", printed), self.meaning

    @property
    def is_bug(self) -> bool:
        """Whether it ended as nothing may end."""
        return self.exit_code in (1, -1) or "Traceback" in self.remarks


@dataclass
class Counts:
    """What came of the flips of one kind of file."""

    flips: int = 0
    found: int = 0
    refused: int = 0
    same: int = 0
    wrong: int = 0
    bugs: int = 0
    examples: list[str] = field(default_factory=list)


def in_a_child(work: Callable[[], Any]) -> Ended:
    """Do work in a forked process, which has its own threads and ends with them."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if not child:
            signal.alarm(TIMEOUT_S)
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            code = 1
            try:
                work()
                code = 0
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else 0
            except BaseException:
                import traceback  # noqa: PLC0415

                traceback.print_exc()
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)
        _, status = os.waitpid(child, 0)
        texts = [
            (stream.seek(0), stream.read().decode(errors="replace"))[1] for stream in (out, err)
        ]
    return Ended(os.waitstatus_to_exitcode(status), *texts)


def command(root: Path, *arguments: str) -> Ended:
    """Run a command on a root."""

    def work() -> None:
        sys.argv = ["fleet-slip", "--root", str(root), *arguments]
        fleet_slip()

    return in_a_child(work)


def meaning(root: Path) -> str:
    """Return a digest of what a root holds: rows of logs and Gram rows, versions, aliases."""

    def work() -> None:
        warehouse = Warehouse(LocalFolder(root))
        digest = hashlib.sha256()
        for table, order in ((warehouse.logs, "tick"), (warehouse.grams, "feature_set")):
            names = [name for name in table.schema.names if name not in ("file", "day")]
            parts = [
                pq.read_table(path, partitioning=None, columns=names)
                for path in table.snapshot(unchecked=True).paths
            ]
            rows = pa.concat_tables(parts).sort_by(
                [("drive_id", "ascending"), (order, "ascending")]
            )
            with pa.ipc.new_stream(sink := pa.BufferOutputStream(), rows.schema) as writer:
                writer.write_table(rows.combine_chunks())
            digest.update(sink.getvalue())
        for file in sorted(root.glob("models/*/*/*.json")):
            content = json.loads(file.read_text())["content"]
            for varying in ("at", "trained_on"):
                content.pop(varying, None)
            digest.update(json.dumps(content, sort_keys=True).encode())
        print(digest.hexdigest())

    ended = in_a_child(work)
    return ended.printed if not ended.exit_code else ended.remarks


def fill(root: Path) -> None:
    """Make a small data root with every kind of file, and a day of logs without Gram rows."""

    def beside() -> None:
        warehouse = Warehouse(LocalFolder(root))
        refused = [{name: "1" if name != "row" else 1 for name in QUARANTINE_SCHEMA.names}]
        rows = QUARANTINE_SCHEMA.empty_table().from_pylist(refused, schema=QUARANTINE_SCHEMA)
        warehouse.quarantine.snapshot().commit(
            Change(add=[warehouse.quarantine.write_file("refused", rows)])
        )
        DocumentFolder(warehouse.root / "evaluations").append({"format": 1, "values": [1, 2.5]})
        for table in (warehouse.logs, warehouse.grams):
            delta = table.open_delta()
            assert delta is not None
            delta.create_checkpoint()
            seal_checkpoints(table.folder)

    shipped = find_config("campaigns", "smoke").read_text()
    campaign = root.with_name("smoke.toml")
    campaign.write_text(shipped.replace("number_of_days = 2", "number_of_days = 9"))
    steps = (
        ("run", "--campaign", str(campaign), "--days", "8"),
        ("publish", "smoke", "--nested", "ay,yaw_rate", "--force"),
        ("forget", "--drive", "smoke-2024-05-01-0000", "--now"),
    )
    for step in steps:
        ended = command(root, *step)
        assert ended.exit_code == 0, ended
    assert in_a_child(beside).exit_code == 0
    ended = command(root, "simulate", str(campaign))
    assert ended.exit_code == 0, ended


def flip(file: Path, bit: int) -> None:
    """Flip one bit of a file, in its place."""
    with file.open("r+b") as stream:
        stream.seek(bit // 8)
        byte = stream.read(1)[0]
        stream.seek(bit // 8)
        stream.write(bytes([byte ^ 1 << bit % 8]))


@contextlib.contextmanager
def copied(root: Path) -> Iterator[Path]:
    """Yield a copy of a root, for a command that writes."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "data"
        shutil.copytree(root, copy)
        yield copy


def write(root: Path, arguments: Sequence[str], flipped: tuple[Path, int] | None) -> Ended:
    """Run a writing command on a copy; what is left of the flip is taken back before looking."""
    with copied(root) as copy:
        if flipped:
            flip(copy / flipped[0], flipped[1])
            damaged = (copy / flipped[0]).read_bytes()
        given = [text.format(campaign=root.with_name("smoke.toml")) for text in arguments]
        ended = command(copy, *given)
        if flipped and (file := copy / flipped[0]).exists():
            content = file.read_bytes()
            if content[: len(damaged)] == damaged:
                flip(file, flipped[1])
        return Ended(ended.exit_code, "", ended.remarks, meaning(copy))


def judge(counts: Counts, what: str, ended: Ended, usual: Ended) -> None:
    """Count how a command ended after a flip."""
    if ended.is_bug:
        counts.bugs += 1
        counts.examples.append(f"BUG {what}: {ended.remarks.strip()[-300:]}")
    elif ended.exit_code != usual.exit_code:
        counts.refused += 1
    elif ended.exit_code == 0 and ended.answer != usual.answer:
        counts.wrong += 1
        counts.examples.append(f"WRONG {what}")
    else:
        counts.same += 1


def flips(root: Path, number: int, seed: int, kinds: Sequence[str]) -> dict[str, Counts]:
    """Flip bits one after the other, evenly over the kinds of files; count what commands make."""
    rng = random.Random(seed)  # noqa: S311
    reading = {arguments: command(root, *arguments) for arguments in READING}
    writing = {arguments: write(root, arguments, None) for arguments in WRITING}
    for arguments, usual in (reading | writing).items():
        assert usual.exit_code in (0, 5, 7, 10), (arguments, usual)
    found: dict[str, Counts] = collections.defaultdict(Counts)
    for turn in range(number):
        kind = kinds[turn % len(kinds)]
        file = rng.choice(sorted(root.glob(KINDS[kind])))
        bit = rng.randrange(file.stat().st_size * 8)
        counts = found[kind]
        counts.flips += 1
        what = f"bit {bit} of {file.relative_to(root)}"
        flip(file, bit)
        counts.found += command(root, *VERIFY).exit_code == 9
        for arguments, usual in reading.items():
            judge(counts, f"{what}: {' '.join(arguments)}", command(root, *arguments), usual)
        flip(file, bit)
        for arguments, usual in writing.items():
            ended = write(root, arguments, (file.relative_to(root), bit))
            judge(counts, f"{what}: {' '.join(arguments)}", ended, usual)
    return found


def preload() -> None:
    """Import what commands import, once, before any child is forked."""
    for found in pkgutil.walk_packages(package.__path__, "fleet_slip."):
        with contextlib.suppress(ImportError):
            importlib.import_module(found.name)
    importlib.import_module("pandas")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--flips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS), action="append")
    options = parser.parse_args()
    os.environ["FLEET_SLIP_LOG"] = "text"
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "data"
        preload()
        fill(root)
        found = flips(root, options.flips, options.seed, options.kind or list(KINDS))
    names = ("flips", "found", "refused", "same", "wrong", "bugs")
    print(f"{'kind':<26}" + "".join(f"{name:>9}" for name in names))
    for kind, counts in found.items():
        print(f"{kind:<26}" + "".join(f"{getattr(counts, name):>9}" for name in names))
    total = [sum(getattr(counts, name) for counts in found.values()) for name in names]
    print(f"{'all':<26}" + "".join(f"{value:>9}" for value in total), flush=True)
    for counts in found.values():
        for example in counts.examples:
            print(example)
    sys.exit(bool(total[4] or total[5]))


if __name__ == "__main__":
    main()
