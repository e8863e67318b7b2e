"""Small measured files and mappings for the tests."""

import math
import random
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.base import quote_name
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.errors import InputError
from fleet_slip.ingest.checked_columns import IngestCounts
from fleet_slip.ingest.logs import IngestReport, ingest_files, log_table
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_log import open_measured
from fleet_slip.warehouse.warehouse import Warehouse, quarantine_schema
from tests.support.catalog import CATALOG
from tests.support.commands import done_on

TIME = {"column": "t", "unit": "s"}
OWN_CLOCK = {"column": None, "unit": None, "own_clock": True}
DRIVE = {"day": date(2024, 5, 31), "vehicle_id": "car", "vehicle_model": "sedan"}
SIGNALS = {
    "ax": {"column": "ax", "unit": "m/s^2"},
    "sideslip": {"column": "beta", "unit": "deg"},
}
MAPPING_TEXT = """
name = "test"
time = { column = "t", unit = "s" }
drive = { day = 2024-05-31, vehicle_id = "car", vehicle_model = "sedan" }
signals.ax = { column = "ax", unit = "m/s^2" }
signals.sideslip = { column = "beta", unit = "deg" }
"""
"""The mapping of `a_mapping`, as a file."""


@dataclass(frozen=True)
class MeasuredLog:
    """A measured file, ready for the warehouse."""

    drives: pa.Table
    """The catalog's `log_schema`, of extras those that are mapped, by drive_id, then tick.

    Strings are dictionary-encoded.
    """
    quarantine: pa.Table
    """`quarantine_schema`, in the file's order."""
    counts: IngestCounts
    digest: str
    """SHA-256 of the file's bytes and the mapping: what has the same one was ingested before."""


def read_measured(file: Path, mapping: Mapping) -> MeasuredLog:
    """Read a file through a mapping, all of it into memory; see `MeasuredLog`.

    Raises `InputError` if the file cannot be read, is not what the mapping says, or has no usable
    row.
    """
    with open_measured(file, mapping) as stream:
        drives = sorted(stream.drives(), key=lambda drive: drive.drive_id)
    return MeasuredLog(
        log_table(drives, mapping),
        pa.concat_tables([quarantine_schema().empty_table(), *stream.quarantine()]),
        stream.counts,
        stream.digest,
    )


def failure(file: Path, mapping: Mapping | None = None) -> str:
    """Return why a file cannot be read: a line that begins with its name."""
    with pytest.raises(InputError) as caught:
        read_measured(file, mapping or a_mapping())
    message = str(caught.value)
    assert message.startswith(quote_name(file))
    assert "\n" not in message
    return message


def ingest_file(warehouse: Warehouse, file: Path, mapping: Mapping) -> IngestReport:
    """Ingest a single file."""
    (report,) = ingest_files(warehouse, [file], mapping)
    return report


def a_mapping(**changes: Any) -> Mapping:
    """A mapping of t, ax and beta; `time` and `drive` add keys, the rest replaces."""
    catalog: Catalog = changes.pop("catalog", CATALOG)
    time = changes.pop("time", {})
    drive = changes.pop("drive", {})
    document = {
        "name": "test",
        "time": time if "rate_hz" in time else {**TIME, **time},
        "drive": {**DRIVE, **drive},
        "signals": SIGNALS,
        **changes,
    }
    return Mapping.model_validate(document, context=catalog.signals)


def own_clock(**changes: Any) -> Mapping:
    """A mapping of a file whose own clock has a date."""
    return a_mapping(**{"time": OWN_CLOCK, "drive": {"day": None}, **changes})


def csv_text(columns: dict[str, Any], separator: str = ",") -> str:
    """Columns as CSV; None is empty."""
    lines = [separator.join(columns)]
    for row in zip(*columns.values(), strict=True):
        lines.append(separator.join("" if value is None else str(value) for value in row))
    return "\n".join(lines) + "\n"


def read_text(folder: Path, text: str | bytes, mapping: Mapping | None = None) -> MeasuredLog:
    """Write a CSV file and read it through the mapping."""
    file = folder / "log.csv"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_measured(file, mapping or a_mapping())


def read_columns(
    folder: Path, columns: dict[str, Any], mapping: Mapping | None = None
) -> MeasuredLog:
    """Write columns as a CSV file and read it."""
    return read_text(folder, csv_text(columns), mapping)


def good_columns(rows: int = 20) -> dict[str, Any]:
    """Rows at 100 Hz in which nothing is wrong."""
    tick = range(rows)
    return {
        "t": [f"{i / 100:.2f}" for i in tick],
        "ax": [f"{0.1 * i - 1:.1f}" for i in tick],
        "beta": [f"{0.5 * i:.1f}" for i in tick],
    }


def recording(seed: int = 1, rows: int = 600) -> dict[str, list[str]]:
    """A drive with noise, as sensors have it, and a row for the quarantine."""
    noise = np.random.default_rng(seed).normal(size=(2, rows)).cumsum(axis=1) / 50
    ax, beta = ([f"{x:.3f}" for x in np.clip(values, -9, 9)] for values in noise)
    ax[100] = "broken"
    return {"t": [f"{i / 100:.2f}" for i in range(rows)], "ax": ax, "beta": beta}


def ticks(log: MeasuredLog) -> list[int]:
    return list(log.drives["tick"].to_pylist())


def reasons(log: MeasuredLog) -> list[tuple[int, str, str | None]]:
    """Row, reason and signal of each rejected row."""
    return [(q["row"], q["reason"], q["signal"]) for q in log.quarantine.to_pylist()]


def physical(log: MeasuredLog, signal: str, scale: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A signal in SI units, NaN where it is null."""
    counts = log.drives[signal].combine_chunks().cast(pa.float64())
    return np.asarray(counts.to_numpy(zero_copy_only=False) * scale, dtype=np.float64)


OWN_MAPPING = """
name = "own"
[time]
column = "t"
unit = "s"
[drive]
vehicle_id = { column = "car" }
vehicle_model = "own"
day = 2026-05-04
[signals]
ax = { column = "ax", unit = "m/s^2" }
ay = { column = "ay", unit = "m/s^2" }
yaw_rate = { column = "r", unit = "rad/s" }
sideslip = { column = "beta", unit = "rad" }
"""


def own_columns(rng: random.Random, slip: float = -1.0) -> dict[str, list[Any]]:
    """Five seconds of a car on bends."""
    ay = [3 * math.sin(tick / 30) + rng.gauss(0, 0.05) for tick in range(500)]
    return {
        "t": [tick / 100 for tick in range(500)],
        "ax": [rng.gauss(0, 0.3) for _ in ay],
        "ay": ay,
        "r": [value / 20 for value in ay],
        "beta": [slip * value / 200 + rng.gauss(0, 0.0003) for value in ay],
    }


def ingest_own(root: Path, folder: Path, cars: int) -> None:
    """Write a log of each car, `car-0` and so on, and ingest it."""
    rng = random.Random(5)  # noqa: S311
    logs = [own_columns(rng) | {"car": [f"car-{car}"] * 500} for car in range(cars)]
    columns = {name: [value for log in logs for value in log[name]] for name in logs[0]}
    (folder / "log.csv").write_text(csv_text(columns))
    (folder / "own.toml").write_text(OWN_MAPPING)
    done_on(root, "ingest", folder / "log.csv", "--mapping", folder / "own.toml")
    done_on(root, "gram")
