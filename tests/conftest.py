"""Fixtures that several tests share: a small warehouse, and the command line as a user runs it."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, settings

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Change, Unit
from fleet_slip.files.folder import Folder
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.warehouse.tables import Warehouse

COMMAND = str(Path(sys.executable).with_name("fleet-slip"))
DAY = date(2024, 5, 1)

os.environ["FLEET_SLIP_LOG"] = "text"  # a test reads what a person would

# The same examples in every run, and none that fails because the machine is busy. The option
# --hypothesis-profile=search looks for new ones.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("fixed", settings.get_profile("search"), derandomize=True)
settings.load_profile("fixed")


@dataclass(frozen=True)
class Finished:
    """A command that has run."""

    exit_code: int
    stdout: str
    stderr: str

    @property
    def json(self) -> Any:
        return json.loads(self.stdout)


RunCommand = Callable[..., Finished]


@pytest.fixture
def run_command(tmp_path: Path) -> RunCommand:
    """Run `fleet-slip --root <tmp_path>/data ...` in a process of its own."""

    def run(*arguments: str, root: Path | None = None, **options: Any) -> Finished:
        done = subprocess.run(
            [COMMAND, "--root", str(root or tmp_path / "data"), *arguments],
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path,
            **options,
        )
        assert "Traceback" not in done.stderr, done.stderr
        return Finished(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture
def warehouse(tmp_path: Path) -> Warehouse:
    """An empty warehouse."""
    return Warehouse(LocalFolder(tmp_path / "data"))


def path_of(folder: Folder) -> Path:
    """Return where a folder of a file system is."""
    return Path(str(folder))


def random_counts(rng: np.random.Generator, rows: int) -> dict[str, Any]:
    """Counts over the whole int16 range, the extremes among them."""
    counts: dict[str, Any] = {}
    for name in catalogue().signals:
        values = rng.integers(-32768, 32768, rows)
        values[:2] = (-32768, 32767)
        counts[name] = values.astype(np.int16)
    return counts


def log_rows(drive_id: str, counts: dict[str, Any], day: date = DAY, **metadata: Any) -> pa.Table:
    """Rows of the logs for one drive; a signal that is not given is absent."""
    signals = catalogue()
    rows = len(next(iter(counts.values())))
    known: dict[str, Any] = {
        "drive_id": drive_id,
        "vehicle_id": "car-1",
        "vehicle_model": "d_class_sedan",
        "source": "simulated",
        "campaign": "test",
        "track": "waterford_hills",
        "mass_kg": 1320.0,
        "adhesion": 1.0,
        "speed_factor": 0.8,
        "lost_control_s": None,
        "saturated": 0,
        **metadata,
    }
    columns: dict[str, Any] = {"day": [day] * rows}
    columns |= {name: [known[name]] * rows for name in signals.drive}
    columns["tick"] = np.arange(rows, dtype=np.int32)
    columns |= {name: counts.get(name, [None] * rows) for name in signals.signals}
    return pa.table(columns, schema=signals.log_schema)


def land(warehouse: Warehouse, name: str, *drives: pa.Table, day: date = DAY) -> None:
    """Commit drives as one file of the logs."""
    action = warehouse.logs.write_file(name, pa.concat_tables(drives), day)
    warehouse.logs.snapshot().commit(Change(add=[action], units=[Unit(f"test/{name}", 1)]))
