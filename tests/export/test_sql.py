"""Exported SQL, run by two engines, computes what `score` does."""

from fractions import Fraction
from pathlib import Path

import duckdb
import pytest

from fleet_slip.export.compile import angles_by_kernel, compile_program
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion
from tests.export.models import (
    CARS,
    DEFINITIONS,
    MODELS,
    export_texts,
    hostile_drive,
    hostile_version,
    model_of,
)
from tests.export.sql_rows import by_duckdb, by_sqlite, table

EVERY_KIND = model_of(MODELS["every_kind"], name="every_kind")


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


def test_the_statement_says_what_it_is_of() -> None:
    manifest = model_of(dict.fromkeys(DEFINITIONS, Fraction(1, 10**6)))
    files = export_texts(ModelVersion(3, manifest, "ab" * 32), None, "sql")
    for text in (files["sideslip_sideslip.sql"], files["sideslip_sideslip_macro.sql"]):
        assert text.startswith("-- sideslip@3: sideslip_rad")
        assert "ab" * 32 in text


@pytest.mark.parametrize("manifest", [EVERY_KIND, hostile_version().manifest])
def test_the_table_of_checks_holds(tmp_path: Path, manifest: Manifest) -> None:
    """Every kind of column: `car` of the check `extremes` knows all facts and numbers."""
    name = manifest.name
    files = export_texts(ModelVersion(1, manifest, "0" * 64), None, "sql")
    checks = tmp_path / "checks.csv"
    checks.write_text(files[f"sideslip_{name}_checks.csv"])
    with duckdb.connect() as database:
        database.execute(f"CREATE TABLE checks AS FROM read_csv('{checks}')")
        database.execute(files[f"sideslip_{name}_macro.sql"])
        rows, right, angles = database.sql(
            "SELECT count(*), count(*) FILTER (angle IS NOT DISTINCT FROM expected_angle), "
            f"count(DISTINCT angle) FROM checks JOIN sideslip_{name}('checks') "
            "USING (drive_id, tick)"
        ).fetchall()[0]
    assert rows == right == 900
    assert angles > 50
