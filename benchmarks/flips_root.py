"""A small data root with every kind of file, flips in its files, and commands on it."""

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.harness import forked
from fleet_slip.resources import SHIPPED_CONFIGS, folder
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change
from fleet_slip.warehouse.warehouse import CONFIG_VARIABLE, Warehouse, quarantine_schema
from tests.support.commands import COMMAND, PATIENCE_S, run_here

KINDS = {
    "logs": "logs/day=*/*.parquet",
    "Gram rows": "grams/*.parquet",
    "quarantine": "quarantine/*.parquet",
    "commits": "*/_delta_log/*.json",
    "checkpoints": "*/_delta_log/*.checkpoint.parquet",
    "last checkpoint": "*/_delta_log/_last_checkpoint",
    "manifests": "models/*/versions/*.json",
    "trained drives": "models/*/versions/*.bin",
    "histories": "models/*/history/*.json",
    "evaluations": "evaluations/*.json",
    "forgotten": "forgotten/*.json",
    "run records": "runs/*.jsonl",
}

_CAMPAIGN = (
    ("number_of_days = 2", "number_of_days = 9"),
    ("laps = 0.5", "laps = 0.03"),
    ("rows_per_file = 15_000", "rows_per_file = 1_500"),
)
_SEARCH = (
    ("max_features = 14", "max_features = 2"),
    ("max_features = 24", "max_features = 3"),
)
_INPUTS = re.compile(r"(?s)inputs = \[.*?\]\n")
_WINDOWS = re.compile(r'(?s)(\[sets\.windows\].*?windows = \[).*?"yaw_rate_bias",.*?\]')


PASSING = re.compile(
    r'"(seconds|at|host|process|run_id|sha256'
    r'|[a-z_]*(_at|hours|age|bytes|fraction)[a-z_]*)": [^,}\]]*'
)
"""Parts of an output that differ from run to run."""

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
        """Return the parts of the output that must be equal in all successful runs."""
        printed = PASSING.sub("", self.printed)
        return NUMBER.sub(lambda match: f"{float(match[0]):.9g}", printed), self.meaning

    @property
    def is_bug(self) -> bool:
        """Return True if the command crashed: exit code 1, a signal, or a traceback."""
        return self.exit_code == 1 or self.exit_code < 0 or "Traceback" in self.remarks


def command(root: Path, *arguments: str) -> Ended:
    """Run a command on a root, in a forked process that dies if it hangs."""

    def work() -> tuple[int, str, str]:
        signal.alarm(int(PATIENCE_S))
        try:
            done = run_here([COMMAND, "--root", str(root), *arguments])
        except Exception:
            return 1, "", traceback.format_exc()
        return done.exit_code, done.stdout, done.stderr

    ended = forked(work)
    return Ended(-1, "", "it was killed, or hung") if ended.killed else Ended(*ended.result)


@dataclass(frozen=True)
class Flip:
    """A bit of a file below a data root."""

    path: Path
    bit: int

    def __str__(self) -> str:
        """Name it."""
        return f"bit {self.bit} of {self.path}"

    def make(self, root: Path) -> None:
        """Flip the bit, in its place; twice is as before."""
        with (root / self.path).open("r+b") as stream:
            stream.seek(self.bit // 8)
            byte = stream.read(1)[0]
            stream.seek(self.bit // 8)
            stream.write(bytes([byte ^ 1 << self.bit % 8]))


@contextlib.contextmanager
def flipped(root: Path, flip: Flip | None) -> Iterator[None]:
    """Flip a bit, and take back what is left of it afterwards, so that the rest can be looked at.

    A command may append to the file, remove it, or write it anew.
    """
    if flip is None:
        yield
        return
    flip.make(root)
    file = root / flip.path
    damaged = file.read_bytes()
    yield
    if file.exists() and file.read_bytes().startswith(damaged):
        flip.make(root)


@contextlib.contextmanager
def copied(root: Path) -> Iterator[Path]:
    """Yield a copy of a root, for a command that writes."""
    with tempfile.TemporaryDirectory(dir=root.parent) as where:
        copy = Path(where) / "data"
        shutil.copytree(root, copy)
        yield copy


def campaign(root: Path) -> Path:
    """Return the campaign that a root is made of."""
    return root.with_name("smoke.toml")


def write_configs(root: Path) -> None:
    """Write a campaign of short drives, and sets and searches of few columns; choose them."""
    campaign(root).write_text(
        _replace(SHIPPED_CONFIGS.find("campaigns", "smoke").read_text(), _CAMPAIGN)
    )
    write_short_lists(root.with_name("configs"))


def write_short_lists(configs: Path) -> None:
    """Write sets and searches of few columns into a new folder; choose them."""
    (configs / "models").mkdir(parents=True)
    estimator = _replace(SHIPPED_CONFIGS.find("models", "estimator").read_text(), _SEARCH)
    anything, replaced = _INPUTS.subn("", estimator)
    assert replaced == 1
    (configs / "models" / "estimator.toml").write_text(anything)
    features = (folder("configs") / "features.toml").read_text(encoding="utf-8")
    fewer, replaced = _WINDOWS.subn(r'\1"ay_mean", "yaw_rate_bias"]', features)
    assert replaced == 1
    (configs / "features.toml").write_text(fewer)
    os.environ[CONFIG_VARIABLE] = str(configs)


def _replace(text: str, pairs: tuple[tuple[str, str], ...]) -> str:
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


def fill(root: Path) -> None:
    """Make a small data root with every kind of file, and a day of logs without Gram rows."""
    campaign_path = str(campaign(root))
    models = str(Path(__file__).parent / "lists" / "ay_yaw_rate.toml")
    for step in (
        ("run", "--campaign", campaign_path, "--days", "8", "--threads", "1"),
        ("publish", "smoke", "--force", "--models", models),
        ("forget", "--drive", "smoke-2024-05-01-0000", "--now"),
    ):
        _require_done(command(root, *step))
    forked(lambda: _add_what_is_rare(root))
    _require_done(command(root, "simulate", campaign_path, "--threads", "1"))
    for kind, pattern in KINDS.items():
        assert any(root.glob(pattern)), f"no {kind}"


def _require_done(ended: Ended) -> None:
    assert ended.exit_code == 0, ended


def _add_what_is_rare(root: Path) -> None:
    warehouse = Warehouse(LocalFolder(root))
    refused = [{name: "1" if name != "row" else 1 for name in quarantine_schema().names}]
    rows = quarantine_schema().empty_table().from_pylist(refused, schema=quarantine_schema())
    written = warehouse.quarantine.write_file("refused", rows)
    warehouse.quarantine.snapshot().commit(Change(add=[written]))
    DocumentFolder(warehouse.root, "evaluations").append({"format": 1, "values": [1, 2.5]})
    for table in (warehouse.logs, warehouse.grams):
        delta = table.open_delta()
        assert delta is not None
        delta.create_checkpoint()


def digest(root: Path) -> str:
    """Return a digest of what a root means: rows of logs and Gram rows, versions, aliases."""

    def work() -> str:
        warehouse = Warehouse(LocalFolder(root))
        digest = hashlib.sha256()
        for table, order in ((warehouse.logs, "tick"), (warehouse.grams, "feature_set")):
            names = [name for name in table.schema.names if name not in ("file", "day")]
            parts = [
                pq.read_table(path, partitioning=None, columns=names)
                for path in table.snapshot().paths
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
        return digest.hexdigest()

    try:
        return str(forked(work).result)
    except AssertionError as error:
        return str(error)
