"""Exported SQL, run by two engines, computes what `score` does."""

import sqlite3
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pytest

import fleet_slip
from fleet_slip.export.checks import Sample, angles_by_kernel
from fleet_slip.export.compile import compile_program
from fleet_slip.export.program import Car, Program
from fleet_slip.models.model_version import ModelVersion
from tests.export.models import CARS, DEFINITIONS, MODELS, export_texts, hostile_drive, model_of

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


@pytest.mark.parametrize("name", MODELS)
def test_hostile_drives_give_the_angles_of_the_kernel(name: str) -> None:
    manifest = model_of(MODELS[name], Fraction(-1, 700), name)
    program = compile_program(manifest)
    drives = {
        f"drive {seed}": (car, hostile_drive(program, 200, seed)) for seed, car in enumerate(CARS)
    }
    log = table(program, drives)
    angles = {
        (drive, tick): angle
        for drive, (car, samples) in drives.items()
        for tick, angle in enumerate(angles_by_kernel(manifest, program, car, samples))
    }
    there = set(log.select("drive_id", "tick").rows())
    expected = {key: angle for key, angle in angles.items() if key in there}
    files = export_texts(ModelVersion(1, manifest, "0" * 64), None, "sql")
    statement = files[f"sideslip_{name}.sql"]
    assert by_duckdb(statement, log) == expected
    assert by_sqlite(statement, log) == expected
    assert len({*expected.values()}) > 10


def test_the_macro_gives_the_angles_of_score(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    version = fleet.model("smoke")
    macro = export_texts(version, fleet.warehouse, "sql")["sideslip_smoke_macro.sql"]
    log = fleet.sql("SELECT * FROM log WHERE drive_id = 'smoke-2024-05-01-0003'").pl().sort("tick")
    with duckdb.connect() as database:
        database.register("my_log", log.to_arrow())
        database.execute(macro)
        found = database.sql(
            "SELECT angle, sideslip_rad FROM sideslip_smoke('my_log') ORDER BY tick"
        ).fetchall()
    estimates = [np.floor(one / 1e-5 + 0.5) for one in version.predict(log)]
    assert [angle for angle, _ in found] == estimates
    assert np.allclose([rad for _, rad in found], np.array(estimates) * 1e-5, rtol=1e-12)


def test_the_statement_says_what_it_is_of() -> None:
    manifest = model_of(dict.fromkeys(DEFINITIONS, Fraction(1, 10**6)))
    files = export_texts(ModelVersion(3, manifest, "ab" * 32), None, "sql")
    for text in (files["sideslip_sideslip.sql"], files["sideslip_sideslip_macro.sql"]):
        assert text.startswith("-- sideslip@3: sideslip_rad")
        assert "ab" * 32 in text


def test_the_table_of_checks_holds(tmp_path: Path) -> None:
    """Every kind of column: `car` of the check `extremes` knows all facts and numbers."""
    manifest = model_of(MODELS["every_kind"], name="every_kind")
    files = export_texts(ModelVersion(1, manifest, "0" * 64), None, "sql")
    checks = tmp_path / "checks.csv"
    checks.write_text(files["sideslip_every_kind_checks.csv"])
    with duckdb.connect() as database:
        database.execute(f"CREATE TABLE checks AS FROM read_csv('{checks}')")
        database.execute(files["sideslip_every_kind_macro.sql"])
        rows, right, angles = database.sql(
            "SELECT count(*), count(*) FILTER (angle IS NOT DISTINCT FROM expected_angle), "
            "count(DISTINCT angle) FROM checks JOIN sideslip_every_kind('checks') "
            "USING (drive_id, tick)"
        ).fetchall()[0]
    assert rows == right == 900
    assert angles > 50
