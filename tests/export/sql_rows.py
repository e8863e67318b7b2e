"""Exported SQL, run by two engines on drives of counts."""

import sqlite3
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

import duckdb
import numpy as np
import polars as pl

from fleet_slip.export.compile import Sample
from fleet_slip.export.program import Car, Program

TEXTS = {"mass_kg": pl.Float64, "vehicle_model": pl.String}


def table(program: Program, drives: Mapping[str, tuple[Car, list[Sample]]]) -> pl.DataFrame:
    """Drives in SI units, without the ticks at which everything is missing."""
    parts = []
    for name, (car, samples) in drives.items():
        known = dict(
            zip((n.name for n in program.numbers), car.number_counts(program), strict=True)
        )
        columns: dict[str, Any] = {
            one.column: [in_si(s[i], float(one.scale)) for s in samples]
            for i, one in enumerate(program.signals)
        }
        frame = pl.DataFrame(
            {"drive_id": name, "tick": np.arange(len(samples)), **columns},
            schema_overrides={one.column: pl.Float64 for one in program.signals},
        ).filter(~pl.all_horizontal(pl.col([one.column for one in program.signals]).is_null()))
        for fact, kind in TEXTS.items():
            frame = frame.with_columns(pl.lit(car.facts.get(fact), kind).alias(fact))
        for one in program.numbers:
            count = known[one.name]
            value = None if count is None else float(Decimal(count) * one.grain)
            frame = frame.with_columns(pl.lit(value, pl.Float64).alias(one.name))
        parts.append(frame)
    return pl.concat(parts).sample(fraction=1, shuffle=True, seed=1)


def in_si(count: int | None, scale: float) -> float | None:
    return None if count is None else count * scale


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
