"""Small measured files and mappings for the tests."""

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.ingest import Mapping, MeasuredLog, read_measured

TIME = {"column": "t", "unit": "s"}
DRIVE = {"day": date(2024, 5, 31), "vehicle_id": "car", "vehicle_model": "sedan"}
SIGNALS = {
    "ax": {"column": "ax", "unit": "m/s^2"},
    "sideslip": {"column": "beta", "unit": "deg"},
}


def a_mapping(**changes: Any) -> Mapping:
    """A mapping of t, ax and beta; `time` and `drive` add keys, the rest replaces."""
    time = changes.pop("time", {})
    drive = changes.pop("drive", {})
    whole = {
        "name": "test",
        "time": time if "rate_hz" in time else {**TIME, **time},
        "drive": {**DRIVE, **drive},
        "signals": SIGNALS,
        **changes,
    }
    return Mapping.model_validate(whole)


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


def ticks(log: MeasuredLog) -> list[int]:
    return list(log.drives["tick"].to_pylist())


def reasons(log: MeasuredLog) -> list[tuple[int, str, str | None]]:
    """Row, reason and signal of each rejected row."""
    return [(q["row"], q["reason"], q["signal"]) for q in log.quarantine.to_pylist()]


def physical(log: MeasuredLog, signal: str, scale: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A signal in SI units, NaN where it is null."""
    counts = log.drives[signal].combine_chunks().cast(pa.float64())
    return np.asarray(counts.to_numpy(zero_copy_only=False) * scale, dtype=np.float64)
