"""The commands that `benchmarks/interleave.py` pairs, and the small roots on which they meet."""

import csv
import math
import multiprocessing
import os
import random
import shutil
import signal
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks.crash_commands import MAPPING, let_time_pass
from benchmarks.interleave_stops import Environment, Running
from fleet_slip.resources import SHIPPED_CONFIGS, folder
from fleet_slip.storage.folder import TEMPORARY_PREFIX
from fleet_slip.warehouse.warehouse import CONFIG_VARIABLE
from tests.support.catalog import configs_with

CAR = "mini-0000"
"""The car that is to be forgotten: simulated and measured, in what is there and in what comes."""

FIRST_DAY, SECOND_DAY = date(2024, 5, 1), date(2024, 5, 2)
"""`retain` forgets the first day."""

ROWS = 100
"""Rows of a measured drive of another car; one of the car's has one more."""

ADDED = "tyre_pressure"
"""The signal that `migrate` adds."""

NEW_SIGNAL = """
[signals.tyre_pressure]
unit = "Pa"
column = "tyre_pressure_pa"
scale = 1000
min = 0
max = 20000000
role = "input"
description = "Pressure in a tyre"

"""

LISTS = Path(__file__).parent / "lists"
TRAINING = ("publish", "sideslip", "--cohort", "vehicle_model = 'van'", "--force", "--models")
PUBLISH = (*TRAINING, str(LISTS / "ay_by_vehicle.toml"))

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "simulate": ("simulate", "{campaign}", "--threads", "1"),
    "ingest": ("ingest", "{new}", "--mapping", "{mapping}"),
    "replace": ("ingest", "{later}", "--mapping", "{fixed}", "--replace"),
    "gram": ("gram",),
    "publish": PUBLISH,
    "promote": ("promote", "sideslip@1"),
    "compact": ("compact",),
    "vacuum": ("compact", "--retention-hours", "24"),
    "retain": ("forget", "--expired", "--retention", "{retention}"),
    "forget": ("forget", "--vehicle", CAR, "--now"),
    "migrate": ("migrate",),
    "repair": ("verify", "--repair"),
}
LEFT_BY_KILLED = ("ingest", "simulate", "compact")
"""Commands that were killed before their first commit, where `vacuum` comes in."""

SETTLING = (
    *("repair", "migrate", "simulate", "ingest", "replace"),
    *("compact", "publish", "promote", "vacuum"),
)
"""In this order commands are given again; then `gram`, and what forgets comes last."""


@dataclass(frozen=True)
class Inputs:
    """Files that the commands read."""

    folder: Path

    @property
    def files(self) -> Mapping[str, str]:
        """Paths of the files, by their names without suffix."""
        return {path.stem: str(path) for path in self.folder.iterdir()}

    def arguments(self, name: str) -> tuple[str, ...]:
        """Return the command line of a command."""
        return tuple(part.format(**self.files) for part in COMMANDS[name])

    def environment(self, *names: str) -> Environment:
        """Return the environment of commands; migrating needs another catalog."""
        age = "new" if "migrate" in names else "old"
        return {CONFIG_VARIABLE: str(self.folder / f"{age}_configs")}


def write_inputs(where: Path) -> Inputs:
    """Write a campaign of three days of two cars, measured logs, and configs."""
    where.mkdir()
    text = SHIPPED_CONFIGS.find("campaigns", "fleet").read_text(encoding="utf-8")
    for old, new in (
        ('name = "fleet"', 'name = "mini"'),
        ("first_day = 2024-06-01", f"first_day = {FIRST_DAY}"),
        ("number_of_days = 25", "number_of_days = 3"),
        ("drives_per_day = 48", "drives_per_day = 3"),
        ("laps = 1\n", "laps = 0.005\n"),
        ("rows_per_file = 1_000_000", "rows_per_file = 150"),
        ("cars = 300", "cars = 2"),
    ):
        assert old in text, old
        text = text.replace(old, new)
    (where / "campaign.toml").write_text(text, encoding="utf-8")
    mapping = MAPPING.replace(str(FIRST_DAY), str(SECOND_DAY))
    (where / "mapping.toml").write_text(mapping, encoding="utf-8")
    fixed = mapping.replace('column = "beta", unit = "rad"', 'column = "beta", unit = "deg"')
    (where / "fixed.toml").write_text(fixed, encoding="utf-8")
    for name, cars in (("old", ("car-2", "car-3")), ("later", ("car-4",)), ("new", ("car-5",))):
        measure(where / f"{name}.csv", (CAR, *cars))
    days = (date.today() - SECOND_DAY).days
    retention = f"drives_days = {days}\nreplaced_files_hours = 24\n"
    (where / "retention.toml").write_text(retention, encoding="utf-8")
    signals = (folder("configs") / "signals.toml").read_text(encoding="utf-8")
    configs_with(where / "old_configs", signals=signals)
    before, section, after = signals.partition("[drive.drive_id]")
    assert section
    configs_with(where / "new_configs", signals=before + NEW_SIGNAL + section + after)
    return Inputs(where)


def measure(path: Path, cars: tuple[str, ...]) -> None:
    """Write a log in which each car's last row has to be refused."""
    rng = random.Random(path.stem)  # noqa: S311
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "car", "ax", "ay", "r", "beta"])
        for car in cars:
            rows = ROWS + (car == CAR)
            for tick in range(rows + 1):
                ay = 3 * math.sin(tick / 20) + rng.gauss(0, 0.1)
                shown = "broken" if tick == rows else ay
                writer.writerow([tick / 100, car, rng.gauss(0, 1), shown, ay / 20, -ay / 200])


def prepare(root: Path, inputs: Inputs, first: str, second: str) -> Path:
    """Make a root on which two commands have something to do."""
    base = root.with_name("base")
    if not base.exists():
        _fill(base, inputs)
    shutil.copytree(base, root)
    arranging: Mapping[str, Callable[[], None]] = {
        "vacuum": lambda: _leave_what_killed_jobs_leave(root, inputs),
        "repair": lambda: _lose_files(root),
    }
    for name in sorted({first, second} & arranging.keys(), reverse=True):  # vacuum, then repair
        arranging[name]()
    return root


def _fill(root: Path, inputs: Inputs) -> None:
    """Give the commands that come before all others."""
    files = inputs.files
    for arguments in (
        ("simulate", files["campaign"], "--days", "2", "--threads", "1"),
        ("ingest", files["old"], "--mapping", files["mapping"]),
        ("gram",),
        PUBLISH,
        (*TRAINING, str(LISTS / "ax_by_vehicle.toml")),
        ("ingest", files["later"], "--mapping", files["mapping"]),
    ):
        ended = Running(root, arguments, inputs.environment()).end()
        assert ended.exit_code == 0, ended.output


def _leave_what_killed_jobs_leave(root: Path, inputs: Inputs) -> None:
    for name in LEFT_BY_KILLED:
        arguments, environment = inputs.arguments(name), inputs.environment()
        ended = Running(root, arguments, environment, die_before="create_write_transaction").end()
        assert ended.exit_code is None, ended.output
    let_time_pass(root)


def _lose_files(root: Path) -> None:
    """Delete a Gram file."""
    next(iter(sorted(root.glob("grams/*.parquet")))).unlink()


def let_temporary_files_age(root: str) -> None:
    """Let an hour go by for what killed writers left half written; a store has no such files."""
    for file in Path(root).rglob(f"{TEMPORARY_PREFIX}*"):
        os.utime(file, (0, 0))


class LocalRoots:
    """Copies of a prepared root in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def copy(self, prepared: Path) -> str:
        """Return where a new copy is; the one before is gone."""
        root = self._folder / "root"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(prepared, root)
        return str(root)


class StoredRoots:
    """Copies of a prepared root on an S3 server that takes any signature."""

    def __init__(self, url: str, bucket: str) -> None:
        self._url, self._bucket, self._number = url, bucket, 0

    def copy(self, prepared: Path) -> str:
        """Return where a new copy is."""
        from tests.support.s3_server import ACCESS_KEY, SCOPE  # noqa: PLC0415

        self._number += 1
        for file in sorted(prepared.rglob("*")):
            if file.is_file():
                path = f"{self._number}/{file.relative_to(prepared)}"
                request = urllib.request.Request(  # noqa: S310
                    f"{self._url}/{self._bucket}/{path}",
                    data=file.read_bytes(),
                    method="PUT",
                    headers={
                        "Authorization": f"AWS4-HMAC-SHA256 Credential={ACCESS_KEY}/{SCOPE}",
                        "Content-Type": "application/octet-stream",
                    },
                )
                urllib.request.urlopen(request).close()  # noqa: S310
        return f"s3://{self._bucket}/{self._number}"


@contextmanager
def serving(**faults: float) -> Iterator[tuple[str, str]]:
    """Start an S3 server of its own process, let this one find it, and return its URL and a bucket.

    `faults` says how it misbehaves, as `tests.support.s3_server.Faults`.
    """
    methods = multiprocessing.get_context("spawn")
    parent_end, child_end = methods.Pipe()
    process = methods.Process(target=_serve, args=(child_end, faults), daemon=True)
    process.start()
    environment, bucket = parent_end.recv()
    os.environ.update(environment)
    yield environment["AWS_ENDPOINT_URL"], bucket
    process.terminate()
    process.join()


def _serve(connection: Any, faults: dict[str, float]) -> None:
    from tests.support.s3_server import Server  # noqa: PLC0415 - flask and moto, here only

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server = Server()
    connection.send((server.environment, server.bucket().removeprefix("s3://")))
    with server.misbehaving(**faults):
        signal.pause()
