"""Exported SQL, run by two engines, computes what `score` does."""

from fractions import Fraction
from pathlib import Path

import duckdb
import numpy as np
import pytest

import fleet_slip
from fleet_slip.export.compile import angles_by_kernel, compile_program
from fleet_slip.models.registry import ModelVersion
from tests.export.models import CARS, DEFINITIONS, MODELS, export_texts, hostile_drive, model_of
from tests.export.sql_rows import by_duckdb, by_sqlite, table


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
