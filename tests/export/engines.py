"""Exported ONNX graphs and SQL, run by other engines on drives of counts."""

import sqlite3
from collections.abc import Sequence
from typing import Any

import duckdb
import numpy as np
import onnxruntime
import polars as pl

from fleet_slip.export.files import export_files
from fleet_slip.export.onnx import UNKNOWN
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import Sample
from fleet_slip.models.registry import ModelVersion
from tests.export.cars import Car


def open_session(version: ModelVersion, kind: str) -> onnxruntime.InferenceSession:
    content = export_files(version, None, "onnx")[f"sideslip_{version.manifest.name}_{kind}.onnx"]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def run_drives(
    session: onnxruntime.InferenceSession, program: Program, cars: Sequence[Car], drives: Any
) -> Any:
    """Drive cars side by side, shape (cars, ticks, signals) with NaN; return (cars, ticks)."""
    facts = {
        "facts": [car.fact_counts(program) for car in cars],
        "numbers": [car.number_counts(program) for car in cars],
    }
    feeds: dict[str, Any] = {}
    for node in session.get_inputs():
        if node.name in facts:
            values = [[UNKNOWN if n is None else n for n in row] for row in facts[node.name]]
            feeds[node.name] = np.array(values, np.int64)
        elif node.name != "signals":
            empty = UNKNOWN if node.name.startswith("ring") else 0
            feeds[node.name] = np.full((len(cars), node.shape[1]), empty, np.int64)
    names = [node.name for node in session.get_outputs()]
    angles = []
    for tick in range(drives.shape[1]):
        computed = session.run(None, {**feeds, "signals": drives[:, tick]})
        outputs = dict(zip(names, computed, strict=True))
        angles.append(outputs.pop("angle")[:, 0])
        feeds |= {name.removesuffix("_next"): value for name, value in outputs.items()}
    return np.array(angles).T


def in_si(program: Program, samples: Sequence[Sample], dtype: str) -> Any:
    counts = np.array([[np.nan if n is None else n for n in row] for row in samples], float)
    return (counts * [float(signal.scale) for signal in program.signals]).astype(dtype)


def by_duckdb(statement: str, log: pl.DataFrame) -> dict[tuple[str, int], int | None]:
    with duckdb.connect() as database:
        database.register("log", log.to_arrow())
        rows = database.sql(f"SELECT drive_id, tick, angle FROM ({statement})").fetchall()
    return {(drive, tick): angle for drive, tick, angle in rows}


def by_sqlite(statement: str, log: pl.DataFrame) -> dict[tuple[str, int], int | None]:
    database = sqlite3.connect(":memory:")
    database.execute(f"CREATE TABLE log ({', '.join(log.columns)})")
    database.executemany(f"INSERT INTO log VALUES ({', '.join('?' * log.width)})", log.rows())
    # SQLite computes a column again wherever it is named, unless told otherwise: docs/export.md.
    rows = database.execute(statement.replace(" AS (\n", " AS MATERIALIZED (\n")).fetchall()
    database.close()
    return {(drive, tick): angle for drive, tick, angle, _ in rows}
